import json

import cv2
import numpy as np
import pytest
from test_demo_scene import CAMERA, FRAMING

from bikeped.conformance.scenario import load_scenario, parse_scenario
from bikeped.demo import (
    DrawnBoxDetector,
    bundled_scenario,
    read_sidecar,
    sidecar_path,
    write_clip,
)
from bikeped.errors import CaptureError
from bikeped.types import Kind

SHORT = (
    "name: Short\nagents:\n"
    "  - {id: 4, kind: pedestrian, path: [[0.0, 5, -8], [0.5, 5, -7]]}\n"
    "  - {id: 9, kind: truck, path: [[0.2, 0, -2], [0.5, 3, -2]]}\n"
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "short.avi"
    seen = []
    write_clip(
        parse_scenario(SHORT, "test"),
        path,
        CAMERA,
        FRAMING,
        size=(640, 360),
        fps=10,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1] == (11, 11)
    return path


def test_clip_plays(clip):
    video = cv2.VideoCapture(str(clip))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 11
    assert video.get(cv2.CAP_PROP_FPS) == 10
    count = 0
    while True:
        ok, frame = video.read()
        if not ok:
            break
        assert frame.shape == (360, 640, 3)
        count += 1
    assert count == 11


def test_clip_hands_out_whole_jpegs(clip):
    video = cv2.VideoCapture(str(clip))
    video.set(cv2.CAP_PROP_FORMAT, -1)
    raw = video.read()[1].tobytes()
    assert raw[:2] == b"\xff\xd8"
    assert cv2.imdecode(np.frombuffer(raw, np.uint8), 1).shape == (360, 640, 3)


def test_riff_sizes_and_index_are_right(clip):
    data = clip.read_bytes()
    assert int.from_bytes(data[4:8], "little") == len(data) - 8
    movi = data.index(b"movi")
    index = data.rindex(b"idx1")
    assert int.from_bytes(data[movi - 4 : movi], "little") == index - movi
    entries = data[index + 8 :]
    assert len(entries) == 11 * 16
    for i in range(11):
        offset = int.from_bytes(entries[16 * i + 8 : 16 * i + 12], "little")
        size = int.from_bytes(entries[16 * i + 12 : 16 * i + 16], "little")
        at = movi + offset
        assert data[at : at + 4] == b"00dc"
        assert int.from_bytes(data[at + 4 : at + 8], "little") == size
        assert data[at + 8 : at + 10] == b"\xff\xd8"


def test_the_same_scenario_gives_the_same_bytes(clip, tmp_path):
    again = tmp_path / "again.avi"
    write_clip(parse_scenario(SHORT, "x"), again, CAMERA, FRAMING, size=(640, 360), fps=10)
    assert again.read_bytes() == clip.read_bytes()
    assert sidecar_path(again).read_bytes() == sidecar_path(clip).read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"again.avi", "again.boxes.jsonl"}


def test_detector_reads_the_boxes_frame_by_frame(clip):
    detector = DrawnBoxDetector(sidecar_path(clip))
    header, frames = read_sidecar(sidecar_path(clip))
    assert len(detector) == header["frames"] == len(frames) == 11
    assert "simulated" in detector.name
    first, third = detector.answer(0), detector.answer(2)
    assert first.kind.tolist() == [Kind.PEDESTRIAN]
    assert third.kind.tolist() == [Kind.PEDESTRIAN, Kind.VEHICLE]
    assert np.allclose(third.box_px[1], frames[2][1].box_px, atol=0.01)
    assert np.allclose(third.confidence, 0.9)
    assert len(detector.answer(10)) == 0, "nobody is there after the last waypoint"
    assert len(detector.answer(11)) == len(detector.answer(-1)) == 0


def test_recall_and_noise_are_off_by_default_and_seeded(clip):
    exact = DrawnBoxDetector(sidecar_path(clip))
    noisy = DrawnBoxDetector(sidecar_path(clip), noise_px=2.0, seed=1)
    other = DrawnBoxDetector(sidecar_path(clip), noise_px=2.0, seed=2)
    backwards = [noisy.answer(i).box_px for i in range(4, -1, -1)][::-1]
    for i in range(5):
        box = noisy.answer(i).box_px
        assert (box == backwards[i]).all()
        assert (box != exact.answer(i).box_px).any()
        assert (box != other.answer(i).box_px).any()
        assert (box[:, 2:] >= box[:, :2]).all()
    deaf = DrawnBoxDetector(sidecar_path(clip), recall=0.0)
    assert all(len(deaf.answer(i)) == 0 for i in range(11))
    half = DrawnBoxDetector(sidecar_path(clip), recall=0.5, seed=3)
    found = sum(len(half.answer(i)) for i in range(11))
    assert 0 < found < sum(len(exact.answer(i)) for i in range(11))
    with pytest.raises(ValueError, match="recall"):
        DrawnBoxDetector(sidecar_path(clip), recall=1.5)


@pytest.mark.parametrize(
    "text", ["", "not json\n", '{"format": "other 3", "frames": 0}\n', '{"format": 1}\n', "[]\n"]
)
def test_a_file_that_is_no_sidecar_is_refused(tmp_path, text):
    path = tmp_path / "x.boxes.jsonl"
    path.write_text(text)
    with pytest.raises(CaptureError, match=r"x\.boxes\.jsonl"):
        read_sidecar(path)


def test_a_cut_sidecar_is_refused(clip, tmp_path):
    path = tmp_path / "cut.boxes.jsonl"
    path.write_text("\n".join(sidecar_path(clip).read_text().splitlines()[:-2]) + "\n")
    with pytest.raises(CaptureError, match="holds 9 frames"):
        read_sidecar(path)


def test_clip_errors_name_the_file(tmp_path):
    scenario = parse_scenario(SHORT, "test")
    with pytest.raises(CaptureError, match=r"\.avi"):
        write_clip(scenario, tmp_path / "a.mp4", CAMERA, FRAMING, size=(64, 36))
    with pytest.raises(CaptureError, match="cannot be written"):
        write_clip(scenario, tmp_path / "none" / "a.avi", CAMERA, FRAMING, size=(64, 36))


def test_bundled_scenario_is_the_documented_story():
    scenario = load_scenario(bundled_scenario())
    assert 16 <= scenario.duration_s <= 20
    kinds = [agent.kind for agent in scenario.agents]
    assert kinds.count("pedestrian") == 1
    assert kinds.count("cyclist") == 2
    assert min(a.start_s for a in scenario.agents if a.kind == "pedestrian") > 1
    walker = next(a for a in scenario.agents if a.kind == "pedestrian")
    assert walker.path[-1, 1] == 5.0, "the crossing is at x = 5"
    json.dumps(scenario.story)

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bikeped.errors import CaptureError
from bikeped.faults import Fault
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens
from bikeped.overlay.camera_view import draw_overlay
from bikeped.overlay.drawing import INK, KIND_COLOUR, SIGNAL_COLOUR, encode_jpeg
from bikeped.overlay.overlay_data import OverlayData, ground_projector
from bikeped.overlay.radar import RadarProjection, draw_radar
from bikeped.overlay.video import VideoWriter, compose
from bikeped.types import Colour, Decision, Detections, Kind, PairMetrics, Signal, State, Tracks

GREY = np.full((432, 768, 3), 120, np.uint8)
PAIR = PairMetrics(12, 7, 10.9, 11.2, 0.067, 0.28, 4.3, 1.9, 24.8)


def moment(state=State.ALERT, **changes):
    detections = Detections(
        np.array([1, 0], np.int8),
        np.array([0.9, 0.8], np.float32),
        np.array([[500, 150, 560, 260], [200, 160, 230, 250]], np.float32),
    )
    tracks = Tracks(
        2.0,
        np.array([7, 12, 15]),
        np.array([0, 1, 1], np.int8),
        np.array([[10.0, -5.0], [9.0, 6.0], [15.0, 0.0]]),
        np.array([[0.0, 1.2], [0.0, -4.3], [-3.0, 0.0]]),
        np.array([0.0, 0.0, 0.8]),
        np.array([1, 0, -1]),
    )
    pair = PAIR if state >= State.WARNING else None
    decision = Decision(2.0, state, f"{state.name}: because.", pair)
    whole = OverlayData(detections, tracks, decision, 60, 2.0, latency_s=0.05)
    return replace(whole, **changes)


def has(image, colour):
    return bool((image == np.array(colour, np.uint8)).all(-1).any())


def changed(a, b):
    return (a != b).any(-1)


@pytest.mark.parametrize("state", list(State))
def test_banner_has_the_colour_of_the_light(state):
    image = compose(GREY, moment(state), (768, 432))
    assert image.shape == GREY.shape
    assert tuple(image[2, 2].tolist()) == SIGNAL_COLOUR[state.name]
    assert (GREY == 120).all(), "the picture given was drawn into"


def test_fault_is_hatched_and_never_blue_green_or_red():
    signal = Signal("FAULT", Colour.ORANGE, faults=(Fault("camera", "camera.error", "silent"),))
    image = compose(GREY, moment(State.ALERT, signal=signal), (768, 432))
    strip = image[1]
    assert has(strip[None], SIGNAL_COLOUR["FAULT"])
    assert has(strip[None], INK)
    assert not has(image, SIGNAL_COLOUR["ALERT"])
    assert moment(signal=signal).sentence == "camera: silent"


def test_boxes_lie_where_the_detector_said_at_any_scale():
    quiet = moment(State.IDLE, tracks=Tracks.empty(2.0))
    for scale in (1.0, 0.5):
        size = (round(768 * scale), round(432 * scale))
        rgb = np.full((size[1], size[0], 3), 120, np.uint8)
        image = draw_overlay(rgb, quiet, scale=scale)
        u, v = round(500 * scale), round(205 * scale)
        assert tuple(image[v, u].tolist()) == KIND_COLOUR[Kind.CYCLIST]
        assert tuple(image[v, u + round(30 * scale)].tolist()) == (120, 120, 120)


def test_alert_makes_the_pair_stand_out_and_warning_does_not():
    alert = draw_overlay(GREY, moment(State.ALERT))
    warning = draw_overlay(GREY, moment(State.WARNING))
    assert has(alert, SIGNAL_COLOUR["ALERT"])
    assert not has(warning, SIGNAL_COLOUR["ALERT"])
    assert has(warning, SIGNAL_COLOUR["WARNING"])


def test_an_unseen_track_is_drawn_where_it_is_on_the_ground():
    def to_frame(xy):
        return np.stack([384 + 20 * xy[:, 1], 432 - 10 * xy[:, 0]], axis=1)

    with_track = draw_overlay(GREY, moment(State.IDLE), ground_to_frame=to_frame)
    without = draw_overlay(GREY, moment(State.IDLE))
    v, u = np.nonzero(changed(with_track, without))
    ring = (v >= 432 - 150) & (v <= 432 - 144 + 3)  # its lower half: the label is above
    assert ring.any()
    assert abs(u[ring].min() - (384 - 12)) <= 3
    assert abs(u[ring].max() - (384 + 12)) <= 3


def test_projector_agrees_with_the_camera_and_hides_what_is_behind():
    framing = Framing(3840, 2160, 3840, 3500)
    camera = GroundCamera(
        Lens.from_circle("equidistant", 1750, 197.9),
        1752.69,
        1804.54,
        3.6576,
        window_px=framing.window_px,
    )
    small = framing.for_frame(1280, 720)
    uv = ground_projector(camera, small)(np.array([[10.0, 3.0], [-5.0, 1.0], [0.5, 0.0]]))
    back, valid = camera.ground(small.frame_to_crop(uv[:1]))
    assert valid.all()
    assert np.allclose(back, [[10.0, 3.0]], atol=1e-6)
    assert np.isnan(uv[1]).all()
    assert uv[2, 1] > 720, "a point below the picture keeps its pixel"


def test_radar_puts_a_track_at_its_place():
    frame = RadarProjection.fit(480, 640)
    one = moment(State.SAFE)
    tracks = replace(one.tracks, velocity_mps=np.zeros((3, 2)))
    image = draw_radar(replace(one, tracks=tracks), (480, 640))
    for xy, kind in (((10.0, -5.0), Kind.PEDESTRIAN), ((9.0, 6.0), Kind.CYCLIST)):
        u, v = frame.u0 + xy[1] * frame.px_per_m, frame.v0 - xy[0] * frame.px_per_m
        assert np.allclose(frame.pixels(xy), (u, v))
        assert tuple(image[round(v), round(u)].tolist()) == KIND_COLOUR[kind]
    assert frame.pixels((25.0, 0.0))[1] >= 0
    assert frame.pixels((0.0, -25.0))[0] >= 0
    assert frame.pixels((0.0, 25.0))[0] <= 480
    assert frame.pixels((-5.0, 0.0))[1] <= 640


def test_radar_marks_far_tracks_on_the_rim():
    frame = RadarProjection.fit(480, 640)
    one = moment(State.SAFE)
    far = replace(one.tracks, xy_m=np.array([[40.0, 0.0], [9.0, 6.0], [15.0, 0.0]]))
    image = draw_radar(replace(one, tracks=far), (480, 640))
    u, v = frame.pixels((25.0, 0.0)).round().astype(int)
    near = image[max(v - 2, 0) : v + 3, u - 2 : u + 3].reshape(-1, 3).astype(int)
    r, g, b = near[near.sum(1).argmax()]
    assert r > 1.5 * b
    assert g > 1.5 * b


def test_radar_pair_is_red_only_in_alert():
    assert has(draw_radar(moment(State.ALERT), (480, 640)), SIGNAL_COLOUR["ALERT"])
    assert not has(draw_radar(moment(State.WARNING), (480, 640)), SIGNAL_COLOUR["ALERT"])


def test_radar_shows_the_trail():
    bare = moment(State.SAFE)
    trail = np.array([[6.0, -9.0], [8.0, -7.0], [10.0, -5.0]])
    image = draw_radar(replace(bare, history={7: trail, 99: trail + 5}), (480, 640))
    difference = changed(image, draw_radar(bare, (480, 640)))
    u, v = RadarProjection.fit(480, 640).pixels((7.0, -8.0)).round().astype(int)
    assert difference[v - 1 : v + 2, u - 1 : u + 2].any()
    u, v = RadarProjection.fit(480, 640).pixels((12.0, -3.0)).round().astype(int)
    assert not difference[v - 1 : v + 2, u - 1 : u + 2].any(), "a track that is gone left a trail"


@pytest.mark.parametrize("size", [(1600, 720), (1280, 480)])
def test_compose_has_the_size_asked_for_and_repeats(size):
    first = compose(GREY, moment(), size)
    assert first.shape == (size[1], size[0], 3)
    assert (first == compose(GREY, moment(), size)).all()


@pytest.mark.parametrize("tracks", [Tracks.empty(0.0)])
def test_empty_data_draw(tracks):
    empty = OverlayData(
        Detections.empty(), tracks, Decision(0.0, State.IDLE, "IDLE: nobody."), 0, 0.0
    )
    compose(GREY, empty)
    lost_pair = replace(moment(), tracks=tracks)
    assert lost_pair.pair_rows() is None
    compose(GREY, lost_pair)


def test_jpeg_is_the_picture():
    image = compose(GREY, moment(), (640, 360))
    data = encode_jpeg(image, 95)
    back = cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), 1), cv2.COLOR_BGR2RGB)
    assert back.shape == image.shape
    assert np.abs(back.astype(int) - image).mean() < 4


def test_video_writer_writes_a_video_and_only_at_close(tmp_path):
    path = tmp_path / "out.mp4"
    with VideoWriter(path, 30, (320, 180)) as writer:
        for grey in range(0, 100, 10):
            writer.write(np.full((180, 320, 3), (200, grey, 0), np.uint8))
        assert not path.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 10
    frame = video.read()[1]
    assert frame[90, 160, 2] > 150, "red and blue are swapped"
    assert frame[90, 160, 0] < 60


def test_video_writer_discards_on_an_exception_and_refuses_other_sizes(tmp_path):
    def interrupted():
        with VideoWriter(tmp_path / "out.mp4", 30, (320, 180)) as writer:
            writer.write(np.zeros((10, 10, 3), np.uint8))

    with pytest.raises(ValueError, match="expected"):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["no/such/folder.mp4", "out.mov"])
def test_video_writer_says_why_it_cannot_open(tmp_path, name):
    with pytest.raises(CaptureError, match=r"\.mp4|folder"):
        VideoWriter(tmp_path / name, 30, (320, 180))


def test_video_writer_is_closed_once_and_for_all(tmp_path):
    writer = VideoWriter(tmp_path / "out.mp4", 30, (320, 180))
    picture = np.zeros((180, 320, 3), np.uint8)
    writer.write(picture)
    writer.close()
    writer.close()
    with pytest.raises(ValueError, match="closed already"):
        writer.write(picture)


def test_video_writer_refuses_a_size_that_no_encoder_takes(tmp_path):
    with pytest.raises(CaptureError, match="cannot write MP4"):
        VideoWriter(tmp_path / "out.mp4", 30, (0, 0))
    assert list(tmp_path.iterdir()) == []


def test_video_writer_without_pictures_is_an_error(tmp_path):
    writer = VideoWriter(tmp_path / "out.mp4", 30, (320, 180))
    with pytest.raises(CaptureError, match="no picture"):
        writer.close()
    assert list(tmp_path.iterdir()) == []

"""From the configuration to the checks of each picture, and from those to the light."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from drawn_detectors import OracleDetector
from pipeline_fakes import Rig

from bikeped.config.load import load_config
from bikeped.errors import ConfigError
from bikeped.faults import Effect
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.clip import AviWriter
from bikeped.lab.rendering.dataset import random_scenario
from bikeped.monitor.picture_health import PictureHealth
from bikeped.monitor.verdicts import Verdict
from bikeped.pipeline.picture_monitor import UNCHECKED, PictureChecks, drift_check, picture_monitor
from bikeped.pipeline.replay import replay
from bikeped.types import Detections, ImageArray
from bikeped.web.align_save import REFERENCE, file_hash, save

ROOT = Path(__file__).parents[2]
ALIGNED = {"height_m": 3.9, "pitch_deg": -6.25}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in ("config.yaml", "camera_calibration.json"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    (tmp_path / "config.yaml").chmod(0o640)
    return tmp_path / "config.yaml"


def picture(place: Path, *overrides: str) -> ImageArray:
    """The street through the camera that the configuration describes."""
    camera = scene_camera(load_config(place, overrides), (960, 540))
    return ScenePainter(random_scenario(1), camera, Conditions(place=5)).frame(1.0)


def test_aligning_is_one_step(place: Path) -> None:
    aligned = [f"camera.{key}={value}" for key, value in ALIGNED.items()]
    saved = save(place, ALIGNED, file_hash(place), picture=picture(place, *aligned))
    assert saved.reference == place.with_name(REFERENCE)
    assert saved.reference.stat().st_mode & 0o777 == 0o640
    assert saved.no_reference == ""
    loaded = load_config(place)
    assert loaded.config.camera.reference == REFERENCE
    check = drift_check(loaded)
    drift = [check.update(picture(place), float(second)) for second in range(5)][-1]
    assert drift is not None
    assert not drift.since_start
    assert drift.degrees < 0.05
    # The camera is knocked, and aligned again: what it sees then is the reference.
    knocked = picture(place, "camera.pitch_deg=-9.5")
    moved = [check.update(knocked, 10.0 + second) for second in range(6)][-1]
    assert moved is not None
    assert moved.moved
    assert moved.pitch_deg == pytest.approx(-3.25, abs=0.1)
    save(place, {"pitch_deg": -9.5}, file_hash(place), picture=knocked)
    check = drift_check(load_config(place))
    drift = [check.update(knocked, float(second)) for second in range(5)][-1]
    assert drift is not None
    assert not drift.moved


def test_without_a_reference_the_start_is_it(place: Path) -> None:
    check = drift_check(load_config(place))
    shown = [check.update(picture(place), float(second)) for second in range(4)]
    assert shown[:3] == [None] * 3
    assert shown[3] is not None
    assert shown[3].since_start


def test_a_picture_that_shows_nothing_is_no_reference(place: Path) -> None:
    save(place, ALIGNED, file_hash(place), picture=picture(place))
    dark = np.zeros((540, 960, 3), np.uint8)
    saved = save(place, {"height_m": 3.95}, file_hash(place), picture=dark)
    assert saved.reference is None
    assert "only 0 places can be recognised" in saved.no_reference
    assert "  reference: null\n" in place.read_text()
    assert save(place, {"height_m": 4}, file_hash(place)).no_reference == "there is no picture"


def test_a_reference_that_does_not_fit_is_named_with_the_remedy(place: Path) -> None:
    saved = save(place, ALIGNED, file_hash(place), picture=picture(place))
    with pytest.raises(ConfigError, match=r"another lens, pose or .* set camera\.reference: null"):
        drift_check(load_config(place, ["camera.pitch_deg=-1"]))
    assert saved.reference is not None
    saved.reference.write_text("{}")
    with pytest.raises(ConfigError, match=r"camera_reference\.json: is not a camera reference"):
        drift_check(load_config(place))
    saved.reference.unlink()
    with pytest.raises(ConfigError, match=r"camera\.reference: camera_reference\.json cannot be"):
        drift_check(load_config(place))


def replayed(place: Path, pictures: list[ImageArray], folder: Path) -> list[dict[str, object]]:
    """The frames' event lines of a replay of `pictures` at 30 frames/s; no person is detected."""
    clip, events = folder / "clip.avi", folder / "events.jsonl"
    with AviWriter(clip, 30, (480, 270)) as writer:
        for rgb in pictures:
            writer.write(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=90))
    blind = OracleDetector(lambda number: Detections.empty())
    replay(load_config(place), str(clip), detector=blind, events=events)
    return [json.loads(line) for line in events.read_text().splitlines()[1:]]


def test_a_recording_is_judged_on_its_own_time(place: Path, tmp_path: Path) -> None:
    loaded = load_config(place)
    painter = ScenePainter(
        random_scenario(1), scene_camera(loaded, (480, 270)), Conditions(place=5)
    )
    good = [painter.frame(number / 30) for number in range(60)]
    lines = replayed(place, good + [np.zeros_like(good[0])] * 45, tmp_path)
    assert {line["light"] for line in lines[10:60]} == {"IDLE"}
    assert not any(line["faults"] for line in lines[10:60])
    black = {"source": "picture", "code": "picture.black", "detail": "The picture is black."}
    assert lines[90]["light"] == "FAULT"
    assert black in lines[90]["faults"]  # type: ignore[operator]


class Checks:
    """A picture monitor that says what the test wants."""

    def __init__(self, checks: PictureChecks) -> None:
        self.checks = checks

    def update(self, rgb: ImageArray, time_s: float) -> PictureChecks:
        return self.checks


def active(code: str) -> PictureChecks:
    return PictureChecks((Verdict(code, 2.0, 1.0, 0.0, True, f"{code} it is"),))


async def test_what_each_effect_does_to_the_light() -> None:
    checks = Checks(PictureChecks())
    async with Rig() as rig:
        rig.detection.picture_monitor = checks  # type: ignore[assignment]
        await rig.frames(6)
        assert rig.recorder.name == "IDLE"
        checks.checks = active("picture.underexposed")
        await rig.frames(1)
        assert rig.recorder.name == "IDLE"
        assert [fault.code for fault in rig.loop.monitor.notices()] == ["picture.underexposed"]
        checks.checks = active("picture.blurred")
        await rig.frames(1)
        assert rig.recorder.name == "FAULT"
        assert rig.recorder.faults == ("picture: picture.blurred it is",)
        checks.checks = PictureChecks()
        await rig.frames(1)  # withheld only: the good frames before it still count
        assert rig.recorder.name == "IDLE"
        checks.checks = active("picture.covered")
        await rig.frames(1)
        checks.checks = PictureChecks()
        await rig.frames(1)
        assert rig.recorder.name == "FAULT"
        assert rig.recorder.faults[0].startswith("recovering: ")


def test_a_bug_in_the_checks_withholds_and_does_not_raise(
    place: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monitor = picture_monitor(load_config(place))
    assert monitor is not None
    monkeypatch.setattr(PictureHealth, "update", lambda *_: 1 / 0)
    [fault] = monitor.update(picture(place), 0.0).faults()
    assert fault.code == "picture.check_failed"
    assert fault.kind.effect is Effect.WITHHELD
    assert "division by zero" in caplog.text


def test_switched_off_it_is_named(place: Path) -> None:
    loaded = load_config(place, ["monitor.picture=false"])
    assert picture_monitor(loaded) is None
    assert UNCHECKED.kind.effect is Effect.NOTICE

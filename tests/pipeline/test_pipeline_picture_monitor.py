"""From a saved alignment to the service's drift check."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.errors import ConfigError
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.dataset import random_scenario
from bikeped.pipeline.picture_monitor import drift_check
from bikeped.types import ImageArray
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

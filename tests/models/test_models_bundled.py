"""The detector that comes with bikeped: there, small, honest about itself, and named `bundled`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bikeped.cli.main import main
from bikeped.config import load_config, road_region
from bikeped.detection import load_detector
from bikeped.detection.hashing import sha256_of
from bikeped.models import BUNDLED, BUNDLED_FILE, NOT_FOR_STREETS, model_file
from bikeped.service.doctor import check_model
from bikeped.training.card_text import reached


@pytest.fixture(scope="module")
def loaded():
    return load_config(None, ("detection.model=bundled",))


@pytest.fixture(scope="module")
def card():
    return json.loads(BUNDLED_FILE.with_suffix(".json").read_text())


def test_it_loads_without_being_told_anything_about_it(loaded):
    detector = load_detector(loaded.config.detection, loaded.base_dir)
    assert detector.input_size == (1056, 608)
    assert detector.layout == "yolov8"
    assert detector.family == "ultralytics"
    answer = detector.infer(np.full((540, 960, 3), 120, np.uint8), 1920, 1080)
    assert len(answer.detections) == 0
    # The deployed camera's road is half of its picture, and takes half of the time.
    road = load_detector(loaded.config.detection, loaded.base_dir, road_region(loaded))
    assert road.input_size == (1056, 320)


def test_the_card_is_this_files(card):
    assert card["model"]["sha256"] == sha256_of(BUNDLED_FILE)
    assert card["model"]["bytes"] == BUNDLED_FILE.stat().st_size <= 4_000_000
    text = BUNDLED_FILE.with_suffix(".md").read_text()
    assert "must not be used for a street" in text


def test_the_card_says_whether_its_aim_is_reached(card):
    """The figures are the card's; `scripts/train-detector` measured them on unseen streets."""
    test = card["configured_camera"]
    assert test["confidence"] == load_config(None).config.detection.confidence
    text = BUNDLED_FILE.with_suffix(".md").read_text()
    assert ("**Reached.**" in text) == reached(test)
    assert ("**It falls short:**" in text) != reached(test)
    # A model that is worse than the one before is no progress.
    for kind, least in (("pedestrian", 0.89), ("cyclist", 0.92)):
        assert test["kinds"][kind]["within_15_m"]["recall"] >= least
    assert test["false_pedestrian_or_cyclist_per_100_frames"] <= 1.0


def test_bundled_is_no_file_name(tmp_path):
    assert model_file(BUNDLED, tmp_path) == BUNDLED_FILE
    assert model_file("other.onnx", tmp_path) == tmp_path / "other.onnx"
    config = tmp_path / "config.yaml"
    config.write_text("camera: {radius_px: 1750, fov_deg: 197.9}\ndetection: {model: bundled}\n")
    assert load_config(config).config.detection.model == BUNDLED


def test_config_check_finds_it(capsys):
    assert main(["config", "check", "--set", "detection.model=bundled", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["model"] == str(BUNDLED_FILE)


def test_the_doctor_warns_of_it(loaded):
    finding = check_model(loaded)
    assert finding.status == "warn"
    assert NOT_FOR_STREETS in finding.detail


def test_the_default_configuration_names_no_model():
    assert load_config(None).config.detection.model is None

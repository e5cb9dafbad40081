"""The detector that comes with bikeped: there, small, honest about itself, and named `bundled`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bikeped.cli.main import main
from bikeped.config.build import road_region
from bikeped.config.load import load_config
from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector, sha256_of
from bikeped.lab.rendering import ScenePainter, scene_camera
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenario
from bikeped.lab.training.model_card import meets_target, render_card
from bikeped.models import BUNDLED, BUNDLED_FILE, BUNDLED_INT8_FILE, NOT_FOR_STREETS, model_file
from bikeped.pipeline.doctor import check_model
from bikeped.types import Kind

CARD = Path(__file__).parents[2] / "docs" / "bundled-detector.md"


@pytest.fixture(scope="module")
def loaded():
    return load_config(None, ("detection.model=bundled",))


@pytest.fixture(scope="module")
def card():
    return json.loads(BUNDLED_FILE.with_suffix(".json").read_text())


def test_it_loads_without_being_told_anything_about_it(loaded):
    detector = load_detector(loaded.config.detection, loaded.base_dir)
    assert detector.input_size == (1152, 672)
    assert detector.layout == "yolov8"
    assert detector.family == "ultralytics"
    answer = detector.infer(np.full((540, 960, 3), 120, np.uint8), 1920, 1080)
    assert len(answer.detections) == 0
    # The deployed camera's road is half of its picture, and takes half of the time.
    road = load_detector(loaded.config.detection, loaded.base_dir, road_region(loaded))
    assert road.input_size == (1152, 352)


def test_the_card_is_this_files(card):
    assert card["model"]["sha256"] == sha256_of(BUNDLED_FILE)
    assert card["model"]["bytes"] == BUNDLED_FILE.stat().st_size
    assert card["model"]["int8_sha256"] == sha256_of(BUNDLED_INT8_FILE)
    assert card["model"]["int8_bytes"] == BUNDLED_INT8_FILE.stat().st_size
    assert BUNDLED_FILE.stat().st_size + BUNDLED_INT8_FILE.stat().st_size <= 4_000_000
    text = CARD.read_text()
    assert "must not be used for a street" in text
    assert text == render_card(card), "scripts/train-detector --card writes it anew"


def test_the_card_says_whether_its_aim_is_reached(card):
    """The figures are the card's; `scripts/train-detector` measured them on unseen streets."""
    test = card["configured_camera"]
    assert test["confidence"] == load_config(None).config.detection.confidence
    text = CARD.read_text()
    assert ("**Reached.**" in text) == meets_target(test)
    assert ("**It falls short:**" in text) != meets_target(test)
    # A model that is worse than the one before is no progress.
    for kind, least in (("pedestrian", 0.95), ("cyclist", 0.95)):
        assert test["kinds"][kind]["within_15_m"]["recall"] >= least
    assert test["false_pedestrian_or_cyclist_per_100_frames"] <= 1.0


def test_bundled_is_no_file_name(tmp_path):
    assert model_file(BUNDLED, tmp_path) == BUNDLED_FILE
    assert model_file(BUNDLED, tmp_path, on_cpu=True) == BUNDLED_INT8_FILE
    for on_cpu in (False, True):
        assert model_file("other.onnx", tmp_path, on_cpu=on_cpu) == tmp_path / "other.onnx"
    config = tmp_path / "config.yaml"
    config.write_text("camera: {radius_px: 1750, fov_deg: 197.9}\ndetection: {model: bundled}\n")
    assert load_config(config).config.detection.model == BUNDLED


def test_a_processor_gets_it_in_eight_bits(loaded):
    detector = load_detector(loaded.config.detection, loaded.base_dir)
    assert ("small-int8.onnx" in detector.name) == ("CPU" in detector.name)
    assert detector.model_hash in {sha256_of(BUNDLED_FILE), sha256_of(BUNDLED_INT8_FILE)}


def test_rounded_to_eight_bits_it_sees_the_same_street(loaded):
    scenario = load_scenario(bundled_folder() / "dense-pedestrian-group.yaml")
    image, _ = ScenePainter(scenario, scene_camera(loaded, (1920, 1080))).draw(3.0)
    found = []
    for file in (BUNDLED_FILE, BUNDLED_INT8_FILE):
        config = DetectionConfig(model=str(file), providers=("cpu",), confidence=0.1)
        found.append(load_detector(config, file.parent).infer(image, 1920, 1080).detections)
    assert min(len(one) for one in found) >= 3
    for kind in Kind:
        assert abs(*(np.diff([int((one.kind == kind).sum()) for one in found]))) <= 1


def test_config_check_finds_it(capsys):
    assert main(["config", "check", "--set", "detection.model=bundled", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["model"] == str(BUNDLED_FILE)


def test_the_doctor_warns_of_it(loaded):
    finding = check_model(loaded)
    assert finding.status == "warn"
    assert NOT_FOR_STREETS in finding.detail


def test_the_default_configuration_names_no_model():
    assert load_config(None).config.detection.model is None

"""The file that a calibration leaves, read back by everything that reads it; and the page."""

from __future__ import annotations

import datetime
import functools
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from calibration_scenes import boards, camera, found

from bikeped.config.build import ground_camera
from bikeped.config.load import load_config
from bikeped.errors import CalibrationError
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import RefusedImage
from bikeped.lab.calibration.capture.coverage import CircleSector, Coverage
from bikeped.lab.calibration.capture.images import CalibrationImage
from bikeped.lab.calibration.report.html_report import report_page
from bikeped.lab.calibration.report.results import (
    CalibrationResult,
    FieldOfView,
    calibration_cautions,
    calibration_data,
    circle_radius_px,
    field_of_view,
    write_calibration,
)
from bikeped.lab.calibration.solver.lens_model import LensModel
from bikeped.lab.calibration.solver.model_comparison import (
    ModelComparison,
    fit_models,
    recommend_model,
)
from bikeped.lab.calibration.solver.observations import OutlierCorner, prepare_observations
from bikeped.lab.simulation.suite import Suite
from bikeped.pipeline.track_and_decide import GroundMapper

FRAMING = Framing(3840, 2160, 3840, 3500)
K = (0.01, -0.012, 0.004, -0.0007)
NOW = datetime.datetime(2031, 5, 6, 7, 8, 9, tzinfo=datetime.timezone.utc)


@pytest.fixture(scope="module")
def done() -> ModelComparison:
    """A 200 degree lens with four radial terms in the 3500 px crop."""
    drawn = camera("equidistant", 100.0, K)
    views = boards(drawn, 12, noise_px=0.3)
    prepared = prepare_observations(
        found(views, [RefusedImage("<b>x.jpg", "same picture as a & b")])
    )
    models = [
        LensModel("equidistant"),
        LensModel("equidistant", 4),
        LensModel("equidistant", 2, True),
    ]
    return fit_models(prepared, models, 3)


def the_field(done: ModelComparison, name: str = "equidistant+k4") -> FieldOfView:
    return field_of_view(done.fits[name], 1750.0, FRAMING.window_px)


def write_pair(done: ModelComparison, folder: Path, name: str = "equidistant+k4") -> Path:
    """The calibration file and a configuration that uses it."""
    data = calibration_data(done.prepared, done.fits[name], the_field(done, name), FRAMING, NOW)
    write_calibration(folder / "measured.json", data)
    config = folder / "config.yaml"
    config.write_text("camera: {calibration: measured.json, height_m: 3.6576}\n")
    return config


def test_the_ground_camera_has_exactly_the_fitted_lens(
    done: ModelComparison, tmp_path: Path
) -> None:
    loaded = load_config(write_pair(done, tmp_path))
    own = ground_camera(loaded)
    fit = done.fits["equidistant+k4"]
    assert own.lens.focal_px == fit.focal_px
    assert own.lens.k == fit.state.terms
    assert (own.cx, own.cy) == (fit.cx, fit.cy)
    assert math.degrees(2 * own.lens.max_theta_rad) == pytest.approx(200, abs=1.5)
    theta = np.linspace(0, own.lens.max_theta_rad, 50)
    np.testing.assert_allclose(own.lens.radius(theta), fit.state.radius_px(theta), rtol=1e-12)
    # The installer's way, by radius and field of view, gives the same lens.
    data = json.loads((tmp_path / "measured.json").read_text())
    again = Lens.from_circle(data["model"], data["radius_px"], data["fov_deg"], own.lens.k)
    assert again.focal_px == pytest.approx(fit.focal_px, rel=1e-14)
    both = load_config(
        tmp_path / "config.yaml",
        [f"camera.radius_px={data['radius_px']!r}", f"camera.fov_deg={data['fov_deg']!r}"],
    )
    assert ground_camera(both).lens.focal_px == pytest.approx(fit.focal_px, rel=1e-14)


def test_run_replay_and_conformance_read_all_four_terms(
    done: ModelComparison, tmp_path: Path
) -> None:
    config = write_pair(done, tmp_path)
    loaded = load_config(config)
    cut = load_config(config, ["camera.k3=0", "camera.k4=0"])
    pixel = np.array([[2900.0, 2900.0]])
    suites = [Suite.load([], loaded), Suite.load([], cut)]
    judged = [GroundMapper(loaded), GroundMapper(cut)]  # the loop's own, for run and replay
    for all_four, two in (suites, judged):
        assert all_four.camera.lens.k == done.fits["equidistant+k4"].state.terms
        here, _ = all_four.camera.ground(pixel)
        there, _ = two.camera.ground(pixel)
        assert np.abs(here - there).max() > 0.05  # metres: the higher terms count


def test_the_file_has_its_keys(done: ModelComparison, tmp_path: Path) -> None:
    write_pair(done, tmp_path)
    data = json.loads((tmp_path / "measured.json").read_text())
    fit = done.fits["equidistant+k4"]
    assert list(data)[:10] == [
        *("model", "cx", "cy", "focal_length", "fov_deg", "radius_px"),
        *("k1", "k2", "k3", "k4"),
    ]
    assert data["rms_error_px"] == fit.rms_px
    assert data["cross_validated_px"] == fit.cross_validated_px
    assert (data["num_frames"], data["num_points"]) == (12, 12 * 48)
    assert (data["frame_width"], data["frame_height"]) == (3840, 2160)
    assert (data["pad_size"], data["crop_size"]) == (3840, 3500)
    assert data["date"] == "2031-05-06T07:08:09+00:00"
    assert data["pictures_hash"] == "0" * 64
    assert "theta^8" in data["convention"]
    assert data["software_version"]


def test_the_former_file_is_kept(done: ModelComparison, tmp_path: Path) -> None:
    path = tmp_path / "measured.json"
    assert write_calibration(path, {"n": 1}) is None
    assert write_calibration(path, {"n": 2}) == tmp_path / "measured.json.bak"
    assert json.loads(path.read_text()) == {"n": 2}
    assert json.loads((tmp_path / "measured.json.bak").read_text()) == {"n": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["measured.json", "measured.json.bak"]


def test_a_fit_that_is_no_lens_is_not_written(done: ModelComparison) -> None:
    fit = done.fits["equidistant+k4"]
    too_far = FieldOfView(math.radians(179), 4000.0, "the image circle")
    with pytest.raises(CalibrationError, match="no lens over 358"):
        calibration_data(done.prepared, fit, too_far, FRAMING)


def test_words_of_caution(done: ModelComparison) -> None:
    fit = done.fits["equidistant+k4"]
    assert calibration_cautions(done.prepared, fit, the_field(done)) == []
    wide = FieldOfView(math.radians(150), 2000.0, "the image circle")
    assert any("extrapolated" in text for text in calibration_cautions(done.prepared, fit, wide))


def test_the_image_circle_is_measured_on_the_pictures() -> None:
    v, u = np.mgrid[0:780, 0:1030]
    radius = np.hypot(u - 520, v - 380)
    rng = np.random.default_rng(0)
    grays = [
        np.where(radius < 500, rng.integers(20, 255, radius.shape), 12).astype(np.uint8)
        for _ in range(8)
    ]
    assert circle_radius_px(
        functools.reduce(np.maximum, grays), np.array([520.0, 380.0])
    ) == pytest.approx(500, abs=2)
    full = [np.full((780, 1030), 128, np.uint8)]
    assert circle_radius_px(functools.reduce(np.maximum, full), np.array([520.0, 380.0])) is None


class _Links(HTMLParser):
    """What a page asks for from elsewhere, and its tags."""

    def __init__(self) -> None:
        super().__init__()
        self.elsewhere: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href") and value and not value.startswith("data:"):
                self.elsewhere.append(value)


def test_the_page_is_whole_by_itself(done: ModelComparison) -> None:
    told = recommend_model(done)
    chosen = done.fits["equidistant+k2+board"]
    views = done.prepared.observations.names
    gray = np.random.default_rng(1).integers(0, 255, (2160, 3840), dtype=np.uint8)
    prepared = replace(done.prepared, outliers=(OutlierCorner("c.jpg", 7, 31.4),))
    page = report_page(
        CalibrationResult(
            replace(done, prepared=prepared),
            chosen,
            told,
            the_field(done),
            Coverage([CircleSector(1, 1.5, 0, 1, "upper <left>")]),
            ["mind <this>"],
            FRAMING,
        ),
        [CalibrationImage(name, 3840, 2160, "", gray) for name in views],
    )
    parser = _Links()
    parser.feed(page)
    assert parser.elsewhere == []
    assert "script" not in parser.tags
    assert parser.tags.count("svg") == 12
    assert parser.tags.count("image") == 12
    assert page.count("data:image/png;base64,") >= 4
    assert "mind &lt;this&gt;" in page
    assert "upper &lt;left&gt;" in page
    assert "&lt;b&gt;x.jpg" in page
    assert "corner 7: 31.4 px off" in page
    assert "same picture as a &amp; b" in page
    assert f"{chosen.cross_validated_px:.3f} px" in page
    assert re.search(r"<td>k2</td><td>-0\.0\d+", page)

"""Several models on the same corners, and which one is recommended."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import boards, camera, found
from synthetic_boards import BoardBend

from bikeped.geometry.lens import PROJECTIONS, Projection
from bikeped.lab.calibration.capture.coverage import Coverage
from bikeped.lab.calibration.report.results import CalibrationResult, field_of_view, result_data
from bikeped.lab.calibration.solver.lens_fit import LensFit
from bikeped.lab.calibration.solver.lens_model import LensModel, corner_angles
from bikeped.lab.calibration.solver.model_comparison import (
    ModelComparison,
    comparison_models,
    fit_models,
    initial_state,
    paper_criterion,
    recommend_model,
)
from bikeped.lab.calibration.solver.observations import FISHEYE, prepare_observations

WINDOW = (0.0, 0.0, 1000.0, 1000.0)


@pytest.fixture(scope="module")
def bent() -> ModelComparison:
    """An equisolid lens with radial terms, and a bent board."""
    drawn = camera("equisolid", 95.0, (0.02, -0.012, 0.004, -0.0006), size=1000)
    views = boards(drawn, 14, noise_px=0.1, bend=BoardBend(0.03, -0.02, 0.01))
    prepared = prepare_observations(found(views))
    return fit_models(prepared, comparison_models(LensModel("equisolid", 4)), 4)


def held(f: LensFit) -> float:
    assert f.cross_validated_px is not None
    return f.cross_validated_px


def test_all_models_are_compared_and_have_the_names_that_people_rely_on(
    bent: ModelComparison,
) -> None:
    fixed = {*FISHEYE, "equidistant+k2", "equidistant+k4", "equidistant+k4+board"}
    assert fixed <= set(bent.fits)
    assert {"equisolid+k4", "equisolid+k4+board", "orthographic+k2"} <= set(bent.fits)
    assert all(f.name == name for name, f in bent.fits.items())
    assert len({int(f.observations.visible.sum()) for f in bent.fits.values()}) == 1


def test_more_freedom_fits_better_and_the_board_matters_most(bent: ModelComparison) -> None:
    fits = bent.fits
    for projection in ("equidistant", "equisolid"):
        assert fits[projection].rms_px > fits[f"{projection}+k2"].rms_px
        assert fits[f"{projection}+k2"].rms_px >= fits[f"{projection}+k4"].rms_px - 1e-6
    assert held(fits["equisolid+k4+board"]) < 0.8 * held(fits["equisolid+k4"])
    assert held(fits["equisolid+k4+board"]) < 0.17  # 0.1 px a coordinate is 0.141 a point
    assert held(fits["equidistant+k4"]) == pytest.approx(held(fits["equisolid+k4"]), rel=0.01)


@pytest.mark.parametrize("projection", FISHEYE)
def test_a_plain_lens_is_recommended_as_what_it_is(projection: Projection) -> None:
    drawn = camera(projection, 80.0, size=1000)
    prepared = prepare_observations(found(boards(drawn, 10, noise_px=0.3)))
    done = fit_models(prepared, [LensModel(p, t) for t in (0, 2) for p in FISHEYE], 5)
    assert next(iter(done.one_parameter)) == projection
    told = recommend_model(done)
    assert told.name == projection
    assert projection in told.reason
    sentence = paper_criterion(done)
    if projection == "equidistant":
        assert "the equidistant model is the best" in sentence
    else:
        assert f"worse than {projection}" in sentence


def with_errors(done: ModelComparison, errors: dict[str, float]) -> ModelComparison:
    """The same fits with other held-out errors."""
    fits = {
        name: replace(
            done.fits[name],
            held_out_px=np.ones_like(done.fits[name].residuals_px) * error / math.sqrt(2),
        )
        for name, error in errors.items()
    }
    return replace(done, fits=fits)


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ({"equidistant": 1.019, "equidistant+k2": 1.01, "equidistant+k4": 1.0}, "equidistant"),
        ({"equidistant": 1.03, "equidistant+k2": 1.01, "equidistant+k4": 1.0}, "equidistant+k2"),
        ({"equidistant": 1.03, "equidistant+k2": 1.03, "equidistant+k4": 1.0}, "equidistant+k4"),
        ({"equisolid": 1.0, "equidistant": 1.015}, "equidistant"),
        ({"equisolid": 1.0, "equidistant": 1.025}, "equisolid"),
        ({"equidistant+k4": 1.0, "equidistant+k4+board": 0.7}, "equidistant+k4+board"),
    ],
)
def test_the_simplest_within_two_per_cent_is_recommended(
    bent: ModelComparison, errors: dict[str, float], chosen: str
) -> None:
    told = recommend_model(with_errors(bent, errors))
    assert told.name == chosen
    assert told.reason.startswith(chosen)
    assert told.reason.endswith(".")


def test_a_start_for_another_model_keeps_the_radii(bent: ModelComparison) -> None:
    prepared = bent.prepared
    theta = corner_angles(prepared.start, prepared.observations)[prepared.observations.visible]
    other = initial_state(LensModel("equidistant", 4), prepared)
    fitted = bent.fits["equisolid+k4"]
    own = other.lens[2] * PROJECTIONS["equidistant"].radius(theta)
    k = other.terms
    own = own * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    assert np.abs(own - fitted.state.radius_px(theta)).max() < 3.0  # of 500 px


def test_the_json_holds_what_people_rely_on(bent: ModelComparison) -> None:
    told = recommend_model(bent)
    chosen = bent.fits[told.name]
    field = field_of_view(chosen, None, WINDOW)
    data = result_data(CalibrationResult(bent, chosen, told, field, Coverage([]), ["mind the gap"]))
    assert data["cautions"] == ["mind the gap"]
    assert data["coverage"] == {"share": 0, "next": []}
    assert data["boards_total"] == data["boards_used"] == 14
    assert data["refused"] == []
    assert data["corners"] == int(bent.prepared.observations.visible.sum())
    assert data["corners"] >= 14 * 48 - 4  # the bend moves a corner or two out of the picture
    assert sum(data["corners_by_picture"].values()) == data["corners"]
    assert max(data["corners_by_picture"].values()) == data["corners_of_a_board"] == 48
    assert data["corners_left_out"] == []
    assert data["best_one_parameter_model"] == next(iter(bent.one_parameter))
    assert data["recommended"] == told.name in data["fits"]
    for name, fit in data["fits"].items():
        assert {"rms_px", "rms_per_coordinate_px", "cross_validated_px", "cx", "cy", "f"} <= set(
            fit
        )
        assert fit["rms_px"] == pytest.approx(fit["rms_per_coordinate_px"] * math.sqrt(2))
        error = bent.fits[name].residuals_px[bent.fits[name].observations.visible]
        assert fit["rms_px"] == pytest.approx(float(np.sqrt((error**2).sum(1).mean())))
        assert fit["stages"][0]["name"] == "levenberg-marquardt"
        assert all(stage["stopped"] for stage in fit["stages"])


def test_the_field_ends_at_the_circle_or_where_the_fit_ends(bent: ModelComparison) -> None:
    fit = bent.fits["equisolid+k2+board"]
    assert math.degrees(fit.measured_to_rad) > 90
    at_circle = field_of_view(fit, 480.0, WINDOW)
    assert at_circle.ends_at == "the image circle"
    assert fit.state.radius_px(np.asarray(at_circle.half_rad)) == pytest.approx(480.0, abs=0.05)
    corner = field_of_view(fit, None, (400.0, 400.0, 700.0, 700.0))
    assert corner.ends_at == "the corner of the picture"
    far = math.hypot(max(fit.cx - 400, 700 - fit.cx), max(fit.cy - 400, 700 - fit.cy))
    assert corner.circle_px == pytest.approx(far)
    beyond = field_of_view(fit, None, (-9e3, -9e3, 9e3, 9e3))
    assert "the angle where" in beyond.ends_at
    assert beyond.half_rad < math.radians(150)
    fit.lens(beyond.half_rad)

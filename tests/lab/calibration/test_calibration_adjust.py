"""Drawn boards with known truth: lens, poses, board, and what the fit says of itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import PATTERN, boards, camera, found
from synthetic_boards import BoardBend, DrawnCamera

from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.lens import Lens, Projection
from bikeped.lab.calibration.board_view import BoardView
from bikeped.lab.calibration.solver import bundle_adjustment as adjust_module
from bikeped.lab.calibration.solver import lens_fit as validate_module
from bikeped.lab.calibration.solver.board_shape import gauge_basis
from bikeped.lab.calibration.solver.bundle_adjustment import AdjustmentStage, adjust, minimise
from bikeped.lab.calibration.solver.lens_fit import (
    assign_folds,
    fit_lens,
    fit_poses,
    held_out_residuals,
)
from bikeped.lab.calibration.solver.lens_model import CornerObservations, LensModel, residuals
from bikeped.lab.calibration.solver.model_comparison import initial_state
from bikeped.lab.calibration.solver.observations import (
    first_guess,
    median_errors_px,
    prepare_observations,
)

HEIGHT_M = 3.6576
K = (0.004, -0.008, 0.002, -0.0003)


def ground_errors_m(truth: DrawnCamera, lens: Lens, cx: float, cy: float) -> dict[str, float]:
    """How far the fitted camera puts a point on the ground from where it is, worst bearing."""
    true = GroundCamera(truth.lens, truth.cx, truth.cy, HEIGHT_M)
    own = GroundCamera(lens, cx, cy, HEIGHT_M)
    out = {}
    for distance in (10.0, 25.0):
        bearing = np.radians([0, 30, 60, 80, -30, -60, -80])
        xy = distance * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        uv, _ = true.project(xy)
        again, valid = own.ground(uv)
        assert valid.all()
        out[f"{distance:.0f}"] = float(np.linalg.norm(again - xy, axis=1).max())
    return out


@pytest.mark.parametrize("terms", [0, 4])
def test_a_200_degree_lens_is_found_again(terms: int) -> None:
    truth = camera()
    prepared = prepare_observations(found(boards(truth)))
    model = LensModel("equidistant", terms)
    result = fit_lens(prepared.observations, model, initial_state(model, prepared))
    assert math.degrees(result.measured_to_rad) > 97
    assert abs(result.cx - truth.cx) < 0.3
    assert abs(result.cy - truth.cy) < 0.3
    assert abs(result.focal_px / truth.lens.focal_px - 1) < 0.0005
    error = ground_errors_m(truth, result.lens(math.radians(99.9)), result.cx, result.cy)
    assert error["10"] < 0.01
    assert error["25"] < 0.05
    assert 0.26 < result.rms_per_coordinate_px < 0.34


@pytest.mark.parametrize(
    ("projection", "half_deg", "k"),
    [
        ("equidistant", 110.0, K),
        ("equisolid", 110.0, (0.0, 0.0, 0.0, 0.0)),
        ("stereographic", 110.0, (0.0, 0.0, 0.0, 0.0)),
        ("orthographic", 80.0, (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_every_lens_is_found_without_knowing_it(
    projection: Projection, half_deg: float, k: tuple[float, float, float, float]
) -> None:
    truth = camera(projection, half_deg, k)
    views = boards(truth, 20, noise_px=0.0)
    observations = CornerObservations.of(PATTERN, views)
    start = first_guess(observations)
    assert np.median(median_errors_px(start, observations)) < 100  # of 3500
    done = adjust(observations, LensModel(projection, 4 if any(k) else 0), start)
    assert np.abs(done.residuals_px).max() < 1e-4
    assert done.state.lens[2] == pytest.approx(truth.lens.focal_px, rel=1e-7)
    assert done.state.terms == pytest.approx(k, abs=1e-7)
    assert done.stages[0].name == "levenberg-marquardt"
    assert done.stages[1].name == "soft-l1"


def test_a_fifth_of_gross_outliers_hardly_moves_the_focal_length() -> None:
    truth = camera()
    views = boards(truth, outlier_share=0.2)
    observations = CornerObservations.of(PATTERN, views)
    model = LensModel("equidistant")
    # The soft-L1 stage alone: no corner is left out.
    robust = adjust(observations, model, first_guess(observations))
    assert abs(robust.state.lens[2] / truth.lens.focal_px - 1) < 0.001
    # The whole way: they are found, and named.
    prepared = prepare_observations(found(views))
    assert len(prepared.observations) == 42
    share = len(prepared.outliers) / observations.visible.sum()
    assert 0.18 < share < 0.22
    assert min(corner.off_px for corner in prepared.outliers) > 5
    result = fit_lens(prepared.observations, model, initial_state(model, prepared))
    assert abs(result.focal_px / truth.lens.focal_px - 1) < 0.0005
    assert result.rms_per_coordinate_px < 0.34


def test_squared_errors_alone_would_not_survive_them() -> None:
    truth = camera()
    observations = CornerObservations.of(PATTERN, boards(truth, outlier_share=0.2))
    start = first_guess(observations)
    plain = adjust(observations, LensModel("equidistant"), start, robust=False)
    robust = adjust(observations, LensModel("equidistant"), start)
    assert [s.name for s in plain.stages] == ["levenberg-marquardt"]
    error = abs(plain.state.lens[2] - truth.lens.focal_px)
    assert error > 3 * abs(robust.state.lens[2] - truth.lens.focal_px)


def test_a_stage_that_makes_it_worse_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = camera()
    observations = CornerObservations.of(PATTERN, boards(truth, 6))
    good = adjust(observations, LensModel("equidistant"), first_guess(observations)).state

    def worse(observations, model, start, turn_px, name):  # type: ignore[no-untyped-def]
        state, stage = minimise(observations, model, start, turn_px, name)
        if turn_px is None:
            return state, stage
        lens = state.lens + np.array([50.0, 0, 0])
        return replace(state, lens=lens), replace(stage, cost_after=stage.cost_before * 9)

    monkeypatch.setattr(adjust_module, "minimise", worse)
    done = adjust(observations, LensModel("equidistant"), good)
    assert [stage.kept for stage in done.stages] == [True, False]
    assert done.state.lens == pytest.approx(good.lens, abs=0.05)


def test_a_lens_that_shrinks_with_the_angle_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = camera()
    observations = CornerObservations.of(PATTERN, boards(truth, 6))
    good = adjust(observations, LensModel("equidistant", 2), first_guess(observations)).state

    def folded(observations, model, start, turn_px, name):  # type: ignore[no-untyped-def]
        stage = AdjustmentStage(name, 1, 1.0, 0.5, 0.0, "as given", True)
        return replace(start, lens=np.array([*start.lens[:3], -0.3, 0.0])), stage

    monkeypatch.setattr(adjust_module, "minimise", folded)
    done = adjust(observations, LensModel("equidistant", 2), good)
    assert not any(stage.kept for stage in done.stages)
    assert "shrink" in done.stages[0].stopped
    assert done.state.lens == pytest.approx(good.lens)


def test_the_stated_uncertainty_is_that_of_the_noise() -> None:
    truth = camera(size=1000)
    model = LensModel("equidistant", 2)
    scaled = []
    for seed in range(12):
        views = boards(truth, 9, seed=seed)
        observations = CornerObservations.of(PATTERN, views)
        result = fit_lens(observations, model, first_guess(observations, ("equidistant",)))
        wanted = {"cx": truth.cx, "cy": truth.cy, "f": truth.lens.focal_px, "k1": 0.0, "k2": 0.0}
        found_ = dict(zip(model.parameters, result.state.lens, strict=True))
        scaled += [(found_[n] - wanted[n]) / result.uncertainty[n] for n in wanted]
    assert 0.75 < float(np.std(scaled)) < 1.3  # 60 values


BEND = BoardBend(0.03, -0.015, 0.02)


def true_shape() -> np.ndarray:
    """The bend as far as no pose stands for it, in squares."""
    board = PATTERN.corners_m()
    flat = board / PATTERN.square_m
    offset = np.zeros_like(flat)
    offset[:, 2] = BEND.depth_m(PATTERN, board[:, :2]) / PATTERN.square_m
    basis = gauge_basis(flat)
    return (basis @ (basis.T @ offset.reshape(-1))).reshape(-1, 3)


def counted_anyhow(views: list[BoardView]) -> list[BoardView]:
    """Every third picture counts its corners from the other end, one as in a mirror."""
    out = []
    ids = np.arange(PATTERN.count)
    for number, view in enumerate(views):
        if number % 3 == 1:
            view = replace(view, uv_px=view.uv_px[::-1])
        if number == 6:
            mirrored = ids.reshape(6, 8)[:, ::-1].ravel()
            view = replace(view, uv_px=view.uv_px[mirrored])
        out.append(view)
    return out


@pytest.mark.parametrize("anyhow", [False, True])
def test_the_bend_of_a_board_is_found_and_no_part_of_the_lens(anyhow: bool) -> None:
    truth = camera(size=1500)
    views = boards(truth, 20, noise_px=0.1, bend=BEND)
    prepared = prepare_observations(found(counted_anyhow(views) if anyhow else views))
    plain, bent = LensModel("equidistant", 2), LensModel("equidistant", 2, board=True)
    flat = fit_lens(prepared.observations, plain, initial_state(plain, prepared), folds=5)
    result = fit_lens(prepared.observations, bent, initial_state(bent, prepared), folds=5)
    shape = result.state.shape
    wanted = true_shape()
    turned = wanted.reshape(6, 8, 3)[::-1, ::-1].reshape(-1, 3)
    mirrors = [w.reshape(6, 8, 3)[:, ::-1].reshape(-1, 3) * [1, 1, -1] for w in (wanted, turned)]
    off = min(float(np.abs(shape - way)[:, 2].max()) for way in (wanted, turned, *mirrors))
    assert off < 0.008
    assert float(np.abs(wanted[:, 2]).max()) > 0.02
    assert result.cross_validated_px is not None
    assert flat.cross_validated_px is not None
    assert result.cross_validated_px < 0.2
    assert result.cross_validated_px < 0.6 * flat.cross_validated_px
    assert abs(result.focal_px / truth.lens.focal_px - 1) < 0.0005


def test_a_shape_stands_for_no_pose_and_no_scale() -> None:
    flat = PATTERN.corners_m() / PATTERN.square_m
    basis = gauge_basis(flat)
    assert basis.shape == (3 * PATTERN.count, 3 * PATTERN.count - 7)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)
    turn = np.cross(np.array([0.3, -0.2, 0.5]), flat)
    for taken in (flat, turn, np.tile([0.1, -0.4, 0.2], (PATTERN.count, 1))):
        np.testing.assert_allclose(basis.T @ taken.reshape(-1), 0, atol=1e-10)


def test_partial_boards_are_used() -> None:
    truth = camera(size=1000)
    views = []
    for number, view in enumerate(boards(truth, 12, noise_px=0.0)):
        keep = np.arange(len(view)) % 8 > (number % 4)  # columns hidden by a hand
        views.append(replace(view, ids=view.ids[keep], uv_px=view.uv_px[keep]))
    prepared = prepare_observations(found(views))
    assert not prepared.refused
    done = adjust(prepared.observations, LensModel("equidistant"), prepared.start)
    assert done.state.lens[2] == pytest.approx(truth.lens.focal_px, rel=1e-7)
    assert int(prepared.observations.visible.sum()) == sum(len(view) for view in views)


def test_held_out_pictures_do_not_help() -> None:
    truth = camera(size=1000)
    observations = CornerObservations.of(PATTERN, boards(truth, 9))
    done = adjust(observations, LensModel("equidistant", 2), first_guess(observations))
    held = held_out_residuals(done, observations, 3)
    out = assign_folds(9, 3) == 1
    # The same by hand, from scratch.
    train = observations.rows(~out)
    lens = adjust(train, done.model, first_guess(train)).state
    state = replace(
        lens, rotation=done.state.rotation[out], translation=done.state.translation[out]
    )
    own = residuals(fit_poses(state, observations.rows(out)), observations.rows(out))
    np.testing.assert_allclose(held[out], own, atol=0.01)
    # Whatever stands in the held-out pictures, the lens does not know it.
    moved = replace(
        observations, uv_px=np.where(out[:, None, None], 0.97, 1.0) * observations.uv_px
    )
    again = held_out_residuals(done, moved, 3)
    assert np.abs(again[out]).max() > np.abs(held[out]).max()


@pytest.mark.parametrize("board", [False, True])
def test_one_step_predicts_like_a_fit_without_the_picture(
    board: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = camera(size=1000)
    observations = CornerObservations.of(PATTERN, boards(truth, 12, bend=BoardBend(0.02, 0.01)))
    done = adjust(observations, LensModel("equidistant", 2, board), first_guess(observations))
    step = held_out_residuals(done, observations, 0)
    monkeypatch.setattr(validate_module, "_REFIT_BELOW", 1000)
    anew = held_out_residuals(done, observations, 0)
    assert not np.array_equal(step, anew)
    assert np.sqrt((step**2).sum() / (anew**2).sum()) == pytest.approx(1, abs=0.01)
    assert (step**2).sum() > (done.residuals_px**2).sum()


@pytest.mark.parametrize(("pictures", "folds"), [(15, 5), (4, 10), (7, 3), (6, 0)])
def test_folds_are_even(pictures: int, folds: int) -> None:
    count = np.bincount(assign_folds(pictures, folds))
    assert len(count) == min(pictures, folds or pictures)
    assert count.max() - count.min() <= 1

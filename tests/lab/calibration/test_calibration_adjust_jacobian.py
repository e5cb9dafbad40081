"""The closed-form derivatives against finite differences, for every lens, beyond 90 degrees too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bikeped.geometry.lens import Lens, Projection
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    CalibrationState,
    camera_points,
    project,
    rotations,
)
from bikeped.lab.calibration.solver.normal_equations import (
    AdjustmentStep,
    apply_step,
    jacobian,
    normal_equations,
)

PATTERN = BoardPattern(4, 3)
FLAT = PATTERN.corners_m()
LENSES: tuple[Projection, ...] = ("equidistant", "equisolid", "stereographic", "orthographic")


def a_state(
    projection: Projection, theta: float, phi: float, tilt: tuple[float, ...], k: tuple[float, ...]
) -> CalibrationState:
    """Two boards of 4 x 3: one around `theta` from the axis, one across the axis."""
    sight = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    lens = np.array([320.0, 240.0, 150.0, *k])
    turn = rotations(np.array([tilt, (0.2, -0.1, 1.0)]))
    move = np.stack([7 * sight, np.array([0.1, -0.2, 6.0])])
    shape = np.random.default_rng(1).normal(0, 0.01, FLAT.shape)
    return CalibrationState(projection, lens, turn, move, shape)


def pixels(state: CalibrationState) -> np.ndarray:
    return project(state, camera_points(state, FLAT))


def close(found: np.ndarray, expected: np.ndarray) -> None:
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=2e-5 * size + 1e-6)


@pytest.mark.parametrize("projection", LENSES)
@given(
    theta=st.floats(0.0, np.radians(110)),
    phi=st.floats(-np.pi, np.pi),
    tilt=st.tuples(*[st.floats(-1.2, 1.2)] * 3),
    k=st.tuples(*[st.floats(-0.02, 0.02)] * 4),
)
@settings(max_examples=25, deadline=None)
def test_derivatives_are_those_of_the_projection(
    projection: Projection, theta: float, phi: float, tilt: tuple[float, ...], k: tuple[float, ...]
) -> None:
    state = a_state(projection, theta, phi, tilt, k)
    found = jacobian(state, FLAT)
    np.testing.assert_allclose(found.uv_px, pixels(state), atol=1e-6)
    h = 1e-6
    for parameter in range(PLAIN + 4):
        step = h * max(1.0, abs(state.lens[parameter]))
        ahead, behind = state.lens.copy(), state.lens.copy()
        ahead[parameter] += step
        behind[parameter] -= step
        slope = pixels(replace(state, lens=ahead)) - pixels(replace(state, lens=behind))
        close(found.lens[..., parameter], slope / (2 * step))
    for parameter in range(6):
        ways = []
        for sign in (1, -1):
            pose = np.zeros((2, 6))
            pose[:, parameter] = sign * h
            ways.append(pixels(apply_step(state, AdjustmentStep(np.zeros(PLAIN + 4), pose))))
        close(found.pose[..., parameter], (ways[0] - ways[1]) / (2 * h))
    for axis in range(3):
        ways = []
        for sign in (1, -1):
            shape = state.shape.copy()
            shape[:, axis] += sign * h
            ways.append(pixels(replace(state, shape=shape)))
        close(found.shape[..., axis], (ways[0] - ways[1]) / (2 * h))


@pytest.mark.parametrize("projection", LENSES)
def test_on_the_axis_itself_the_derivatives_hold(projection: Projection) -> None:
    state = replace(
        a_state(projection, 0.0, 0.0, (0.0, 0.0, 0.0), (0.01,)), shape=np.zeros_like(FLAT)
    )
    pattern = BoardPattern(3, 3)
    state = replace(state, shape=np.zeros((9, 3)), translation=np.array([[0, 0, 5.0], [0, 0, 4.0]]))
    found = jacobian(state, pattern.corners_m())
    # Moving the middle corner sideways by one unit at distance z moves it by f / z.
    np.testing.assert_allclose(found.pose[0, 4, :, 3:5], np.eye(2) * 150 / 5, atol=1e-6)
    assert np.isfinite(found.pose).all()


@given(vector=st.tuples(*[st.floats(-1.8, 1.8)] * 3))
@settings(max_examples=60, deadline=None)
def test_rotations_are_those_of_scipy(vector: tuple[float, ...]) -> None:
    for scale in (1.0, 1e-7, 0.0):
        turn = rotations(scale * np.array(vector))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        expected = Rotation.from_rotvec(scale * np.array(vector)).as_matrix()
        np.testing.assert_allclose(turn, expected, atol=1e-12)


def test_half_a_turn() -> None:
    for axis in (np.array([1.0, 0, 0]), np.array([0.6, 0.8, 0]), np.array([-0.6, 0, 0.8])):
        expected = Rotation.from_rotvec(axis * np.pi).as_matrix()
        np.testing.assert_allclose(rotations(axis * np.pi), expected, atol=1e-12)


@pytest.mark.parametrize("projection", LENSES)
def test_the_model_is_the_lens_that_the_rest_of_bikeped_uses(projection: Projection) -> None:
    state = a_state(projection, 0.5, 0.3, (0.3, 0.1, 0.2), (0.01, -0.008, 0.002, -0.0005))
    lens = Lens(projection, 150.0, np.radians(80), state.terms)
    points = camera_points(state, FLAT)
    side = np.hypot(points[..., 0], points[..., 1])
    radius = lens.radius(np.arctan2(side, points[..., 2]))
    uv = points[..., :2] * (radius / side)[..., None] + state.lens[:2]
    np.testing.assert_allclose(pixels(state), uv, atol=1e-9)


@pytest.mark.parametrize("bent", [False, True])
def test_the_blocks_solve_the_same_equations_as_the_dense_matrix(bent: bool) -> None:
    state = a_state("equisolid", 1.2, 0.4, (0.3, -0.2, 0.9), (0.01, -0.01))
    rng = np.random.default_rng(0)
    jac = jacobian(state, FLAT)
    error, weight = rng.normal(size=jac.uv_px.shape), rng.uniform(0, 1, jac.uv_px.shape[:2])
    basis = np.linalg.qr(rng.normal(size=(36, 4)))[0] if bent else None
    step = normal_equations(jac, error, weight, basis).step(0.0)

    views, corners = weight.shape
    shared = 5 + (4 if bent else 0)
    dense = np.zeros((views, corners, 2, shared + 6 * views))
    dense[..., :5] = jac.lens
    if basis is not None:
        own = basis.reshape(corners, 3, 4)
        dense[..., 5:9] = np.einsum("vcdk,ckq->vcdq", jac.shape, own)
    for view in range(views):
        at = shared + 6 * view
        dense[view, :, :, at : at + 6] = jac.pose[view]
    root = np.sqrt(weight)[..., None]
    matrix = (dense * root[..., None]).reshape(-1, dense.shape[-1])
    wanted, *_ = np.linalg.lstsq(matrix, -(error * root).reshape(-1), rcond=None)
    found = np.concatenate([step.shared, step.pose.ravel()])
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9)

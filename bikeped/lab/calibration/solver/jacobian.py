"""Derivatives of the pixels by every parameter, in closed form.

With the camera point p = R X + t, s = hypot(px, py), theta = atan2(s, pz), n = |p| and the unit
radius h(theta) = g(theta) (1 + k1 theta^2 + ...), a pixel is (cx, cy) + f h (px, py) / s. Its
derivative along the radius is f h' dtheta, across it f h / s. Nothing divides by pz, so boards
beside and behind the lens plane need no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.geometry.lens import unit_radius, unit_radius_slope
from bikeped.lab.calibration.solver.lens_model import PLAIN, CalibrationState, radial_factor
from bikeped.types import FloatArray


@dataclass(frozen=True)
class Jacobian:
    """Pixels `uv_px` [V, C, 2], and their derivatives.

    `lens` [V, C, 2, 3 + terms]; `pose` [V, C, 2, 6]: a small rotation of the board about the
    camera's axes (radians, after its own rotation), then the translation; `shape` [V, C, 2, 3]: the
    corner's own offset on the board.
    """

    uv_px: FloatArray
    lens: FloatArray
    pose: FloatArray
    shape: FloatArray

    @property
    def parts(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Its arrays, in order."""
        return self.uv_px, self.lens, self.pose, self.shape


def jacobian(state: CalibrationState, flat: FloatArray, *, bent: bool = True) -> Jacobian:
    """The derivatives at `state` for a board that is `flat` [C, 3] plus the state's shape.

    `bent` False leaves the derivatives by the shape out: `shape` [V, C, 2, 0].
    """
    turned = (flat + state.shape) @ state.rotation.transpose(0, 2, 1)
    point = turned + state.translation[:, None]
    # On the axis itself the direction across is free: an offset of 1e-9 chooses one.
    length = np.linalg.norm(point, axis=-1)
    flat_side = np.hypot(point[..., 0], point[..., 1])
    nudge = np.where(flat_side < 1e-9 * length, 1e-9 * length, 0.0)
    x, y, z = point[..., 0] + nudge, point[..., 1], point[..., 2]
    side = np.hypot(x, y)
    square = side * side + z * z
    theta = np.arctan2(side, z)

    k = state.lens[..., PLAIN:]
    base = unit_radius(state.projection, theta)
    grown = radial_factor(theta, k)
    unit = base * grown
    slope = unit_radius_slope(state.projection, theta) * grown + base * _radial_slope(theta, k)
    focal = state.lens[..., 2]
    ux, uy = x / side, y / side

    lens = np.zeros((*theta.shape, 2, state.lens.shape[-1]))
    lens[..., 0, 0] = 1.0
    lens[..., 1, 1] = 1.0
    lens[..., 0, 2] = unit * ux
    lens[..., 1, 2] = unit * uy
    power = focal * base
    for term in range(k.shape[-1]):
        power = power * theta * theta
        lens[..., 0, PLAIN + term] = power * ux
        lens[..., 1, PLAIN + term] = power * uy

    along = focal * slope * z / square  # d radius / d side
    across = focal * unit / side
    inward = -focal * slope * side / square  # d radius / d z
    to_point = np.empty((*theta.shape, 2, 3))
    to_point[..., 0, 0] = along * ux * ux + across * uy * uy
    to_point[..., 0, 1] = (along - across) * ux * uy
    to_point[..., 1, 0] = to_point[..., 0, 1]
    to_point[..., 1, 1] = along * uy * uy + across * ux * ux
    to_point[..., 0, 2] = inward * ux
    to_point[..., 1, 2] = inward * uy

    pose = np.empty((*theta.shape, 2, 6))
    # a . (w x q) = w . (q x a), for the turned corner q and each row a.
    qx, qy, qz = (turned[..., None, axis] for axis in range(3))
    ax, ay, az = (to_point[..., axis] for axis in range(3))
    pose[..., 0] = qy * az - qz * ay
    pose[..., 1] = qz * ax - qx * az
    pose[..., 2] = qx * ay - qy * ax
    pose[..., 3:] = to_point
    shape = to_point @ state.rotation[:, None] if bent else to_point[..., :0]
    radius = focal * unit
    centre = state.lens[..., :2]
    uv = np.stack([centre[..., 0] + radius * ux, centre[..., 1] + radius * uy], axis=-1)
    return Jacobian(uv, lens, pose, shape)


def _radial_slope(theta: FloatArray, k: FloatArray) -> FloatArray:
    """Derivative of `radial_factor` by theta."""
    square = theta * theta
    total = np.zeros_like(theta)
    for number in range(k.shape[-1], 0, -1):
        total = total * square + 2 * number * k[..., number - 1]
    return np.asarray(total * theta)

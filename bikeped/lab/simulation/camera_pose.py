"""Where a simulated camera stands in the world, and which way it looks. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.types import BoolArray, FloatArray


@dataclass(frozen=True)
class CameraPose:
    """Position (x east, y north, metres) and heading of a camera in the world.

    `heading_deg` is counted from east, counter-clockwise: 90 looks north (+y).
    """

    x_m: float
    y_m: float
    heading_deg: float

    def world_to_ground(self, xy_m: npt.ArrayLike) -> FloatArray:
        """World positions [..., 2] in the camera ground frame (x forward, y right)."""
        return self.turn_to_ground(np.asarray(xy_m, np.float64) - (self.x_m, self.y_m))

    def turn_to_ground(self, direction: npt.ArrayLike) -> FloatArray:
        """World directions [..., 2] in the camera ground frame."""
        return np.asarray(np.asarray(direction, dtype=np.float64) @ self._axes().T)

    def ground_to_world(self, xy_m: npt.ArrayLike) -> FloatArray:
        """Camera ground positions [..., 2] in the world."""
        return np.asarray(np.asarray(xy_m, np.float64) @ self._axes() + (self.x_m, self.y_m))

    def _axes(self) -> FloatArray:
        c, s = math.cos(math.radians(self.heading_deg)), math.sin(math.radians(self.heading_deg))
        return np.array([[c, s], [s, -c]])


@dataclass(frozen=True)
class CameraView:
    """The ground that a camera at `pose` looks at: ahead of it, no farther than `reach_m`."""

    pose: CameraPose
    reach_m: float

    def sees(self, xy_m: npt.ArrayLike) -> BoolArray:
        """Which world positions [..., 2] lie in the view; none that are NaN."""
        ground = self.pose.world_to_ground(xy_m)
        near = (ground**2).sum(-1) <= self.reach_m**2
        return np.asarray(near & (ground[..., 0] > 0))

"""The numbers that an installer sets, marks that he measured, and what a pixel reads. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.lens import Lens

#: What may be fitted, as the keys of the camera section are called, and how people say it.
PARAMETERS = {
    "height_m": "height",
    "pitch_deg": "pitch",
    "radius_px": "radius",
    "cx": "centre u",
    "cy": "centre v",
    "heading_deg": "heading",
}
#: One natural unit of each; of the radius and the centre as a share of the radius.
_UNIT = {"height_m": 0.1, "pitch_deg": 1.0, "heading_deg": 1.0}
_SHARE = 0.01


@dataclass(frozen=True)
class Alignment:
    """The installer's numbers; `radius_px`, `cx`, `cy` in crop pixels.

    `radius_px` is the image circle's radius of the projection without its radial terms, as
    `Lens.from_circle` and the key `camera.radius_px` have it.
    """

    height_m: float
    pitch_deg: float
    radius_px: float
    cx: float
    cy: float
    heading_deg: float = 0.0

    @staticmethod
    def of(camera: GroundCamera) -> Alignment:
        """The numbers of a camera."""
        return Alignment(
            height_m=camera.height_m,
            pitch_deg=camera.pitch_deg,
            radius_px=plain_radius_px(camera.lens),
            cx=camera.cx,
            cy=camera.cy,
            heading_deg=camera.heading_deg,
        )

    def camera(self, like: GroundCamera) -> GroundCamera:
        """The camera `like` with these numbers; GeometryError when there is none."""
        if not (math.isfinite(self.radius_px) and self.radius_px > 0):
            raise GeometryError(f"radius_px: {self.radius_px} is no radius; use a positive number")
        was_px = plain_radius_px(like.lens)
        lens = like.lens
        if self.radius_px != was_px:
            lens = replace(lens, focal_px=lens.focal_px * self.radius_px / was_px)
        return replace(
            like,
            lens=lens,
            cx=self.cx,
            cy=self.cy,
            height_m=self.height_m,
            pitch_deg=self.pitch_deg,
            heading_deg=self.heading_deg,
        )

    def unit(self, name: str) -> float:
        """A step of a parameter that a person would call small."""
        return _UNIT.get(name, _SHARE * self.radius_px)


def plain_radius_px(lens: Lens) -> float:
    """Radius at the edge of the field of view without the radial terms."""
    fov_deg = math.degrees(2 * lens.max_theta_rad)
    return lens.focal_px / Lens.from_circle(lens.projection, 1.0, fov_deg).focal_px


@dataclass(frozen=True)
class Mark:
    """A point on the ground: its crop pixel, and what was measured, metres.

    `distance_m` is from the foot of the pole (below the lens); `forward_m` and `right_m` are along
    and across the ground frame's x axis. Distance or forward must be given.
    """

    name: str
    u_px: float
    v_px: float
    distance_m: float | None = None
    forward_m: float | None = None
    right_m: float | None = None

    def __post_init__(self) -> None:
        given = (self.distance_m, self.forward_m, self.right_m)
        if not all(math.isfinite(x) for x in (self.u_px, self.v_px, *given) if x is not None):
            raise GeometryError(f"mark {self.name}: a number is not finite; measure it again")
        if self.distance_m is None and self.forward_m is None:
            raise GeometryError(
                f"mark {self.name}: distance_m: missing; measure from the foot of the pole to it"
            )
        if None not in given:
            raise GeometryError(
                f"mark {self.name}: distance_m, forward_m and right_m are one too many; leave "
                "out distance_m or forward_m"
            )
        if self.distance_m is None:
            return
        if self.distance_m <= 0:
            raise GeometryError(
                f"mark {self.name}: distance_m: {self.distance_m:g} must be above 0"
            )
        across = max(abs(self.forward_m or 0.0), abs(self.right_m or 0.0))
        if across > self.distance_m:
            raise GeometryError(
                f"mark {self.name}: {across:g} m to the side or ahead is more than its distance "
                f"of {self.distance_m:g} m; measure both again"
            )


@dataclass(frozen=True)
class Spacing:
    """The measured distance between two marks, by their index."""

    first: int
    second: int
    distance_m: float


@dataclass(frozen=True)
class Accuracy:
    """Standard errors of what people do: laying a tape, and setting a mark in the picture."""

    tape_m: float = 0.02
    mark_px: float = 2.0


@dataclass(frozen=True)
class Residual:
    """One measurement: what it was, what the fitted camera reads, what it may be off, metres."""

    mark: str  #: name of the mark, or of two, as `1-2`
    what: str  #: distance, forward, right, spacing
    measured_m: float
    read_m: float
    expected_m: float  #: standard error that tape and pixel explain

    @property
    def off_m(self) -> float:
        """Read minus measured."""
        return self.read_m - self.measured_m

    @property
    def strange(self) -> bool:
        """Whether it is more than tape and pixel explain."""
        return abs(self.off_m) > 4 * self.expected_m


@dataclass(frozen=True)
class Fit:
    """A fitted alignment; `error` has the standard error of every fitted parameter."""

    alignment: Alignment
    error: dict[str, float]
    residuals: tuple[Residual, ...]
    spare: int  #: measurements beyond those that the fit needs
    at_10m_error_m: float | None  #: standard error of what reads 10 m; None: 10 m is not in view
    suspect: str | None = None  #: the one mark without which the others agree, if there is one

    @property
    def strange(self) -> tuple[Residual, ...]:
        """Measurements that do not go with the others."""
        return tuple(r for r in self.residuals if r.strange)


def ten_metre_pixel(camera: GroundCamera, distance_m: float = 10.0) -> tuple[float, float] | None:
    """Crop pixel of a point at `distance_m`: straight ahead, or else as near to that as is seen."""
    bearings = np.radians([0, *(s * b for b in range(5, 95, 5) for s in (1, -1))])
    heading = math.radians(camera.heading_deg)
    around = distance_m * np.stack([np.cos(bearings + heading), np.sin(bearings + heading)], axis=1)
    uv, seen = camera.project(around)
    if not seen.any():
        return None
    u, v = uv[int(np.argmax(seen))].tolist()
    return u, v


def reading_m(camera: GroundCamera, uv_px: tuple[float, float]) -> float | None:
    """Distance from the foot of the pole that a crop pixel reads; None on or above the horizon."""
    xy, valid = camera.ground([uv_px])
    return float(np.hypot(*xy[0])) if valid[0] else None

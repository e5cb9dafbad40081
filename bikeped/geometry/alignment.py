"""Camera alignment: its parameters, measured ground marks, and the result of a fit. Pure."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.lens import Lens

#: Parameters that can be fitted: keys of the camera section and their names in messages.
PARAMETER_NAMES = {
    "height_m": "height",
    "pitch_deg": "pitch",
    "radius_px": "radius",
    "cx": "centre u",
    "cy": "centre v",
    "heading_deg": "heading",
}
#: Parameter scales; those of the radius and the centre are a share of the radius.
_SCALE = {"height_m": 0.1, "pitch_deg": 1.0, "heading_deg": 1.0}
_RADIUS_SHARE = 0.01


@dataclass(frozen=True)
class Alignment:
    """Mounting parameters of a camera; `radius_px`, `cx`, `cy` in crop pixels.

    `radius_px` is the radius of the image circle without the radial terms, as in
    `Lens.from_circle` and the key `camera.radius_px`.
    """

    height_m: float
    pitch_deg: float
    radius_px: float
    cx: float
    cy: float
    heading_deg: float = 0.0

    @staticmethod
    def of(camera: GroundCamera) -> Alignment:
        """The parameters of `camera`."""
        c, radius_px = camera, plain_radius_px(camera.lens)
        return Alignment(c.height_m, c.pitch_deg, radius_px, c.cx, c.cy, c.heading_deg)

    def camera(self, like: GroundCamera) -> GroundCamera:
        """`like` with these parameters; GeometryError where they give no camera."""
        if not (math.isfinite(self.radius_px) and self.radius_px > 0):
            raise GeometryError(f"radius_px: {self.radius_px} must be a positive number")
        old_px = plain_radius_px(like.lens)
        lens = like.lens
        if self.radius_px != old_px:
            lens = replace(lens, focal_px=lens.focal_px * self.radius_px / old_px)
        own = asdict(self)
        del own["radius_px"]
        return replace(like, lens=lens, **own)

    def scale(self, name: str) -> float:
        """A small step of a parameter: 0.1 m, 1 degree, or 1 % of the radius."""
        return _SCALE.get(name, _RADIUS_SHARE * self.radius_px)


def plain_radius_px(lens: Lens) -> float:
    """Image radius at the edge of the field of view, without the radial terms."""
    fov_deg = math.degrees(2 * lens.max_theta_rad)
    return lens.focal_px / Lens.from_circle(lens.projection, 1.0, fov_deg).focal_px


@dataclass(frozen=True)
class Mark:
    """A point on the ground: its crop pixel and its measured position, metres.

    `distance_m` is from the point below the lens; `forward_m` and `right_m` are ground coordinates
    (x, y). Distance or forward must be given. Raises GeometryError for contradictory measurements.
    """

    name: str
    u_px: float
    v_px: float
    distance_m: float | None = None
    forward_m: float | None = None
    right_m: float | None = None

    def __post_init__(self) -> None:
        given = (self.distance_m, self.forward_m, self.right_m)
        across = max(abs(self.forward_m or 0.0), abs(self.right_m or 0.0))
        problem = None
        if not all(math.isfinite(x) for x in (self.u_px, self.v_px, *given) if x is not None):
            problem = "a number is not finite; measure it again"
        elif self.distance_m is None:
            if self.forward_m is None:
                problem = "distance_m: missing; measure from the foot of the pole to it"
        elif None not in given:
            problem = (
                "distance_m, forward_m and right_m over-determine it; leave out distance_m or "
                "forward_m"
            )
        elif self.distance_m <= 0:
            problem = f"distance_m: {self.distance_m:g} must be above 0"
        elif across > self.distance_m:
            problem = (
                f"{across:g} m to the side or ahead is more than its distance of "
                f"{self.distance_m:g} m; measure both again"
            )
        if problem:
            raise GeometryError(f"mark {self.name}: {problem}")


@dataclass(frozen=True)
class Spacing:
    """The measured distance between the marks with the indices `first` and `second`."""

    first: int
    second: int
    distance_m: float


@dataclass(frozen=True)
class MeasurementAccuracy:
    """Standard errors of a tape measurement and of a mark placed in the picture."""

    tape_m: float = 0.02
    mark_px: float = 2.0


@dataclass(frozen=True)
class Residual:
    """One measurement beside the value that the fitted camera gives for it, metres."""

    mark: str  #: name of the mark, or of two, as `1-2`
    quantity: str  #: distance, forward, right, spacing
    measured_m: float
    read_m: float  #: by the fitted camera
    standard_error_m: float  #: that tape and pixel explain

    @property
    def error_m(self) -> float:
        """Read minus measured."""
        return self.read_m - self.measured_m

    @property
    def is_outlier(self) -> bool:
        """Whether the error exceeds four standard errors."""
        return abs(self.error_m) > 4 * self.standard_error_m


@dataclass(frozen=True)
class AlignmentFit:
    """A fitted alignment with the standard error of every fitted parameter."""

    alignment: Alignment
    standard_errors: dict[str, float]
    residuals: tuple[Residual, ...]
    redundancy: int  #: measurements minus fitted parameters
    standard_error_at_10m_m: float | None  #: of a point at 10 m; None: 10 m is not in view
    suspect_mark: str | None = None  #: the mark without which all others agree, if there is one

    @property
    def outliers(self) -> tuple[Residual, ...]:
        """Measurements that disagree with the others."""
        return tuple(r for r in self.residuals if r.is_outlier)


def pixel_at_distance(camera: GroundCamera, distance_m: float = 10.0) -> tuple[float, float] | None:
    """Crop pixel of a ground point at `distance_m`, at the smallest bearing that is in view.

    None where the camera sees no point at that distance.
    """
    bearings = np.radians([0, *(s * b for b in range(5, 95, 5) for s in (1, -1))])
    heading = math.radians(camera.heading_deg)
    around = distance_m * np.stack([np.cos(bearings + heading), np.sin(bearings + heading)], axis=1)
    uv, seen = camera.project(around)
    if not seen.any():
        return None
    u, v = uv[int(np.argmax(seen))].tolist()
    return u, v


def ground_distance_m(camera: GroundCamera, uv_px: tuple[float, float]) -> float | None:
    """Distance of a crop pixel's ground point from the foot of the pole; None above the horizon."""
    xy, valid = camera.ground([uv_px])
    return float(np.hypot(*xy[0])) if valid[0] else None

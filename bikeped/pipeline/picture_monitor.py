"""The checks of each picture that a configuration asks for: its health, and the camera's place.

They run in the decoder's thread, on media time, so that a replay is judged as the service is.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.errors import ConfigError, GeometryError
from bikeped.faults import FAULT_KINDS, Effect, Fault
from bikeped.monitor.camera_drift import Drift, DriftCheck
from bikeped.monitor.drift_reference import DriftReference
from bikeped.monitor.picture_health import PictureHealth
from bikeped.monitor.verdicts import Verdict
from bikeped.pipeline.runtime import RateLimitedLogger
from bikeped.types import ImageArray

log = logging.getLogger(__name__)

DRIFT_EVERY_S = 1.0


@dataclass(frozen=True)
class PictureChecks:
    """What the checks say of the newest picture."""

    verdicts: tuple[Verdict, ...] = ()
    drift: Drift | None = None  #: None until there is a reference and a picture to compare
    fault: Fault | None = None  #: of the checks themselves

    def faults(self) -> tuple[Fault, ...]:
        """The faults that they amount to, of every effect."""
        found = [Fault("picture", v.code, v.detail) for v in self.verdicts if v.active]
        others = (None if self.drift is None else self.drift.fault(), self.fault)
        return (*found, *(fault for fault in others if fault is not None))


NO_CHECKS = PictureChecks()
#: Where `monitor.picture` is off.
UNCHECKED = Fault("picture", "picture.unchecked", "not checked: monitor.picture is off")


class PictureMonitor:
    """Checks the pictures of one camera, one after the other, in one thread."""

    def __init__(self, health: PictureHealth, drift: DriftCheck) -> None:
        self._health, self._drift_check = health, drift
        self._drift: Drift | None = None
        self._drift_s = -math.inf
        self._limited_log = RateLimitedLogger(log)

    def update(self, rgb: ImageArray, time_s: float) -> PictureChecks:
        """The checks of a picture [h, w, 3] captured at `time_s`; an error in them is a fault."""
        try:
            verdicts = self._health.update(rgb, time_s)
            # A picture that cannot be trusted says nothing of the camera's place. One with other
            # contents, or with drops on it, may be that of a camera that was knocked.
            trusted = not any(
                (v.active or v.beyond) and FAULT_KINDS[v.code].effect is not Effect.NOTICE
                for v in verdicts
                if v.code not in ("picture.covered", "picture.spray")
            )
            if trusted and time_s >= self._drift_s + DRIFT_EVERY_S:
                self._drift_s = time_s
                self._drift = self._drift_check.update(rgb, time_s)
        except Exception as error:  # noqa: BLE001 - a bug in the checks must not end the decoder
            self._limited_log.failure("picture", error)
            detail = f"cannot be checked ({type(error).__name__})"
            return PictureChecks(fault=Fault("picture", "picture.check_failed", detail))
        return PictureChecks(verdicts, self._drift)


def picture_monitor(loaded: LoadedConfig) -> PictureMonitor | None:
    """The checks that the configuration asks for; None where `monitor.picture` is off.

    Raises ConfigError as `drift_check` does.
    """
    if not loaded.config.monitor.picture:
        return None
    frame, camera = framing(loaded), ground_camera(loaded)
    offset_u, offset_v = frame.offset_px
    circle = None
    if camera.lens.projection != "perspective":
        circle = (
            (camera.cx - offset_u) / frame.sensor_w,
            (camera.cy - offset_v) / frame.sensor_h,
            camera.lens.max_radius_px / frame.sensor_w,
        )
    return PictureMonitor(PictureHealth(circle), drift_check(loaded))


def drift_check(loaded: LoadedConfig) -> DriftCheck:
    """The check against the file `camera.reference`; without one, against the first 2 s.

    Raises ConfigError where the file cannot be read, or was saved with another lens, pose or frame
    size than the configuration has.
    """
    camera, frame, name = ground_camera(loaded), framing(loaded), loaded.config.camera.reference
    try:
        if name is None:
            return DriftCheck(None, camera, frame)
        path = loaded.path(name)
        reference = DriftReference.from_json(path.read_bytes(), str(path))
        return DriftCheck(reference, camera, frame)
    except OSError as error:
        raise ConfigError(
            f"{loaded.source}: camera.reference: {name} cannot be read ({error.strerror}); align "
            "the camera again, or set null"
        ) from error
    except GeometryError as error:
        raise ConfigError(f"{loaded.source}: {error}, or set camera.reference: null") from error

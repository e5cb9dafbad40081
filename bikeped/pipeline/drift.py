"""The drift check that the configuration asks for."""

from __future__ import annotations

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.errors import ConfigError, GeometryError
from bikeped.monitor.camera_drift import DriftCheck
from bikeped.monitor.drift_reference import DriftReference


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

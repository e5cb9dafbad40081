"""What `bikeped run` asks of a configuration beyond its being valid, and what looks like a mistake.

Defaults are for trying things out. On a pole a file that lost its end would fall back to them: it
must not drive a simulated light where a real one was meant.
"""

from __future__ import annotations

from collections.abc import Iterator

from bikeped.config.build import framing, ground_camera
from bikeped.config.lens_check import check_gain
from bikeped.config.load import LoadedConfig
from bikeped.errors import ConfigError, GeometryError

#: Heights in metres outside which a person may have meant feet, or another camera.
_HEIGHTS_M = (2.0, 8.0)
_PITCH_MAX_DEG = 5.0
#: Distance of the optical centre from the middle, in shares of the crop's side.
_CENTRE_SHARE = 0.1


def check_runnable(loaded: LoadedConfig) -> None:
    """ConfigError with one line for what the service must not be started with."""
    config = loaded.config
    needed = ["camera.source", "feedback.light"]
    driver: str = config.feedback.light
    if driver == "lamp":
        needed.append("lamp.driver")
        driver = config.lamp.driver or driver
    if driver == "gpio":
        needed.append("feedback.gpio.chip")
    elif driver == "usb":
        needed.append("feedback.usb.device")
    for key in needed:
        if key not in loaded.named:
            raise ConfigError(
                f"{loaded.source}: {key}: missing; it says which hardware is used, so `run` "
                "takes no default; write it into the file"
            )
    if config.decision.memory_frames < 1:
        raise ConfigError(
            f"{loaded.source}: decision.memory_frames: 0 remembers no cyclist: one that is missed "
            "in a single frame gives no warning; use 1 or more (0 is for bikeped conformance)"
        )
    try:
        check_gain(ground_camera(loaded).lens)
    except GeometryError as error:
        raise ConfigError(f"{loaded.source}: camera: {error}") from error


def is_complete(loaded: LoadedConfig) -> bool:
    """Whether the file ends with `complete: true`, so that nothing of it can be missing."""
    lines = [line for line in loaded.text.splitlines() if line.split("#")[0].strip()]
    return loaded.config.complete and lines[-1].startswith("complete:")


def warnings(loaded: LoadedConfig) -> Iterator[str]:
    """One line for each value that is possible, but is more often a mistake."""
    if not is_complete(loaded):
        yield (
            "complete: missing; a file that was cut off would look the same: write complete: true "
            "as its last line"
        )
    camera = loaded.config.camera
    if camera.height_m > _HEIGHTS_M[1]:
        yield (
            f"camera.height_m: {camera.height_m:g} m is high for a camera on a pole; are these "
            f"feet? {camera.height_m:g} ft are {camera.height_m * 0.3048:.2f} m"
        )
    elif camera.height_m < _HEIGHTS_M[0]:
        yield f"camera.height_m: {camera.height_m:g} m is low for a camera on a pole; in metres?"
    if camera.pitch_deg > _PITCH_MAX_DEG:
        yield (
            f"camera.pitch_deg: {camera.pitch_deg:g} looks up into the sky; a camera that looks "
            "down has a negative pitch"
        )
    ground, sides = ground_camera(loaded), framing(loaded).crop_wh
    for key, centre, side in (("cx", ground.cx, sides[0]), ("cy", ground.cy, sides[1])):
        if abs(centre - (side - 1) / 2) > _CENTRE_SHARE * side:
            yield (
                f"camera.{key}: {centre:g} is far from the middle of the crop, {(side - 1) / 2:g}; "
                "remove the key to take the calibration's"
            )

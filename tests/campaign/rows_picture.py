"""Faults of the picture: rows 4 to 8, 57 and 58."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator

from campaign import pictures
from campaign.registry import row
from campaign.rig import Rig, Running

#: The camera of `pictures`: as the small one, 320 x 212.
CAMERA = ("camera.width=320", "camera.height=212", "camera.radius_px=193")
QUIET_S = 6.0


def _street() -> Iterator[bytes]:
    return pictures.changed(lambda picture: picture)


def _start(rig: Rig) -> Running:
    rig.camera.pictures = _street()
    rig.camera.fps = 15.0
    service = rig.start(None, *CAMERA)
    service.settle()
    time.sleep(QUIET_S)
    return service


def _inject(rig: Rig, name: str, shown: Iterator[bytes], wait_s: float) -> None:
    """Measures FAULT, and that it stays while the fault does; then waits for the street again."""
    began_s = time.monotonic()
    rig.camera.pictures = shown
    delay_s = rig.measure(name, rig.light.until(("orange",), began_s, wait_s))
    if math.isfinite(delay_s):
        time.sleep(2)
        rig.not_reassuring(began_s + delay_s)
    rig.camera.pictures = _street()
    back_s = rig.ready(time.monotonic(), name=None, wait_s=60)
    rig.expect(math.isfinite(back_s), f"no recovery within 60 s after {name}")
    time.sleep(QUIET_S)


@row(4, "an identical frame at 15 a second; a loop of 20", "freeze is detected",
     "one frame <= 2 s; loop <= 5 s", repeat=5)  # fmt: skip
def frozen(rig: Rig) -> None:
    _start(rig)
    for _ in rig.repetitions:
        one = next(rig.camera.pictures)
        _inject(rig, "one frame", itertools.repeat(one), 20)
        loop = list(itertools.islice(_street(), 20))
        _inject(rig, "loop", itertools.cycle(loop), 20)


@row(5, "a black, white, green picture with sensor noise", "FAULT",
     "black <= 1 s; white <= 1 s; green <= 1 s", repeat=5)  # fmt: skip
def one_colour(rig: Rig) -> None:
    _start(rig)
    for _ in rig.repetitions:
        for name, colour in (("black", (0, 0, 0)), ("white", (255, 255, 255)),
                             ("green", (0, 140, 0))):  # fmt: skip
            _inject(rig, name, pictures.changed(pictures.one_colour(*colour), 1.0), 10)


@row(6, "the lens covered by half and wholly", "tamper",
     "half <= 5 s; whole <= 5 s", repeat=5)  # fmt: skip
def covered(rig: Rig) -> None:
    _start(rig)
    for _ in rig.repetitions:
        _inject(rig, "half", pictures.changed(pictures.covered(0.5)), 20)
        _inject(rig, "whole", pictures.changed(pictures.covered(1.0)), 20)


@row(7, "defocus, drops on the lens", "green is withheld",
     "defocus <= 10 s; drops <= 10 s", repeat=5)  # fmt: skip
def degraded(rig: Rig) -> None:
    _start(rig)
    for _ in rig.repetitions:
        _inject(rig, "defocus", pictures.changed(pictures.defocused(4.0)), 25)
        _inject(rig, "drops", pictures.changed(pictures.drops(25)), 25)


@row(8, "the camera turned up by 5 degrees", "drift fault", "FAULT <= 30 s", repeat=3)
def turned(rig: Rig) -> None:
    _start(rig)
    focal_px = 193 / math.radians(36.5)
    up_px = focal_px * math.radians(5)
    for _ in rig.repetitions:
        _inject(rig, "FAULT", pictures.changed(pictures.turned(up_px=up_px)), 60)


@row(57, "the camera rolled by 2 degrees", "drift fault", "FAULT <= 30 s", repeat=3)
def rolled(rig: Rig) -> None:
    _start(rig)
    for _ in rig.repetitions:
        _inject(rig, "FAULT", pictures.changed(pictures.turned(roll_deg=2.0)), 60)


@row(58, "night with lamps, heavy rain, low sun", "no false picture fault",
     "false faults = 0")  # fmt: skip
def hard_light(rig: Rig) -> None:
    for name in ("night", "rain", "low_sun"):
        shown = pictures.changed(getattr(pictures, name))
        rig.camera.pictures = itertools.chain([next(shown)], shown)
        rig.camera.fps = 15.0
        service = rig.start(None, *CAMERA)
        service.until_said("SAFE: |FAULT: ")
        time.sleep(4)
        began_s = time.monotonic()
        time.sleep(30)
        codes = service.health()[1]["fault_codes"]
        false = rig.light.count(("orange",), began_s, time.monotonic())
        false += rig.light.colour() not in ("green", "blue")
        rig.measure("false faults", false)
        rig.saw(f"{name}: {', '.join(codes) or 'no fault'}")
        service.close()

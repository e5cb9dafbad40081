"""Faults of the camera and of what it sends: rows 1 to 3, 9 to 12 and 54."""

from __future__ import annotations

import itertools
import time

from campaign.camera import street
from campaign.registry import row
from campaign.rig import Rig


@row(
    1,
    "camera unplugged for 1 s, and once for 34 s",
    "FAULT, then reconnects",
    "FAULT <= 1 s; ready <= 5 s",
    repeat=20,
    in_tests=True,
)
def unplugged(rig: Rig) -> None:
    service = rig.start()
    service.settle()
    for number in rig.repetitions:
        began_s = rig.fault(rig.camera.unplug)
        time.sleep(34 if number == 19 else 1)
        rig.camera.plug()
        plugged_s = time.monotonic()
        rig.not_reassuring(began_s + 1, plugged_s)
        rig.ready(plugged_s)
        if number < rig.last:  # sooner it would be flicker, which has a row of its own (28)
            time.sleep(max(0.0, began_s + 16 - time.monotonic()))
    said = service.events("FAULT: camera|FAULT: .*stream ended")
    rig.saw(f"{said} lines of FAULT")


@row(
    2,
    "a read of the camera blocks for ever",
    "capture ends and begins anew",
    "FAULT <= 1 s; ready <= 10 s",
    repeat=3,
)
def read_blocks(rig: Rig) -> None:
    for _ in rig.repetitions:
        rig.control()
        began_s = time.monotonic()
        supervisor = rig.supervise(seam="camera")
        rig.ready(began_s, name=None)
        began_s = rig.fault(lambda: rig.control("hang"))
        time.sleep(1)
        rig.control()
        rig.ready(began_s + 1)
        rig.not_reassuring(began_s + 1, began_s + 1)
        supervisor.close()


@row(3, "reads return a stale buffer", "stale by age", "FAULT <= 1 s", repeat=20)
def stale_buffer(rig: Rig) -> None:
    rig.start(seam="camera").settle()
    for _ in rig.repetitions:
        began_s = rig.fault(lambda: rig.control("stale"))
        time.sleep(1)
        rig.not_reassuring(began_s + 1)
        rig.ready(rig.control(), name=None)


@row(
    9,
    "10 % of the pictures cut off or with wrong bytes, then all",
    "dropped; FAULT when none is left",
    "FAULT <= 1 s; ends = 0 times",
    repeat=20,
    in_tests=True,
)
def corrupt(rig: Rig) -> None:
    service = rig.start()
    service.settle()
    count = itertools.count()

    def tenth(jpeg: bytes) -> bytes:
        number = next(count)
        if number % 20 == 0:
            return jpeg[: len(jpeg) // 3]
        return jpeg[:200] + bytes(200) + jpeg[400:] if number % 20 == 10 else jpeg

    for _ in rig.repetitions:
        rig.camera.spoil = tenth
        time.sleep(1.5)
        rig.camera.spoil = lambda jpeg: jpeg
        # Every picture is cut off: what remains is no picture, and its age counts.
        began_s = rig.fault(lambda: setattr(rig.camera, "spoil", lambda jpeg: jpeg[:300]))
        time.sleep(0.5)
        rig.not_reassuring(began_s + 1)
        rig.camera.spoil = lambda jpeg: jpeg
        rig.ready(time.monotonic(), name=None)
    rig.measure("ends", float(service.process.poll() is not None))
    rig.expect("Traceback" not in service.log, "a traceback in the log")


@row(
    10,
    "the stream changes size, then rate, in mid-run",
    "the wrong size is a FAULT, never judged",
    "FAULT <= 1 s; decisions on a wrong table = 0",
    repeat=5,
)
def size_changes(rig: Rig) -> None:
    rig.camera.pictures = street()
    service = rig.start()
    service.settle()
    for _ in rig.repetitions:
        began_s = rig.fault(lambda: setattr(rig.camera, "pictures", street((128, 64))))
        time.sleep(2)
        shown_s = rig.light.reassured_s(began_s + 1, time.monotonic())
        rig.measure("decisions on a wrong table", round(shown_s * 30))
        back_s = time.monotonic()
        rig.camera.pictures = street()
        rig.ready(back_s, name=None)
        rig.camera.fps = 20.0
        time.sleep(1)
        rig.camera.fps = 30.0


@row(
    11,
    "frame rate falls from 30 to 5, then to 2.2 frames/s",
    "named degraded; no flicker of FAULT",
    "degraded <= 2 s; flicker = 0 changes",
    repeat=3,
)
def slow_frames(rig: Rig) -> None:
    service = rig.start()
    service.settle()
    for _ in rig.repetitions:
        rig.camera.fps = 5.0
        named_s = service.until_health(lambda health: bool(health["faults"]), 10)
        rig.measure("degraded", named_s)
        rig.camera.fps = 2.2
        time.sleep(3)
        began_s = time.monotonic()
        time.sleep(12)
        changes = rig.light.count(("green", "blue"), began_s, time.monotonic())
        rig.measure("flicker", changes)
        rig.camera.fps = 30.0
        rig.ready(time.monotonic(), name=None)
        service.until_health(lambda health: not health["faults"], 20)


@row(
    12,
    "time stamps in another order, twice, and from the future",
    "discarded",
    "false alerts = 0; out of service <= 5 s",
    repeat=5,
)
def time_stamps(rig: Rig) -> None:
    service = rig.start(seam="camera")
    service.settle()
    for _ in rig.repetitions:
        began_s = rig.control("shuffled")
        time.sleep(2)
        rig.control("future 3600")
        time.sleep(4)
        back_s = rig.control()
        rig.ready(back_s, name="out of service", wait_s=30)
        rig.measure("false alerts", rig.light.count(("red",), began_s, time.monotonic()))
    rig.expect(service.process.poll() is None, "the service ended")


@row(
    54,
    "a camera password in the address, with / ? # @ and in the path",
    "in no log, fault, page or message",
    "leaks = 0",
)
def password(rig: Rig) -> None:
    secret = "Se4cret"
    leaks = 0
    for address in (
        "http://user:{}/x@127.0.0.1:9/video",
        "http://user:{}?x@127.0.0.1:9/video",
        "http://user:{}#x@127.0.0.1:9/video",
        "http://user:{}@x@127.0.0.1:9/video",
        "http://127.0.0.1:9/user=admin&password={}/video",
        "rtsp://127.0.0.1:9/cam/password={}",
        "rtsp://user:{}@127.0.0.1:9/video",
    ):
        service = rig.start(rig.config(source=f'"{address.format(secret)}"'))
        service.until_said("attempt 2 follows|FAULT: ")
        _, health = service.health()
        time.sleep(0.5)
        found = secret in service.log or secret in str(health)
        rig.expect(not found, f"{address.format('***')}: the password is in log or health")
        leaks += found
        service.close()
    rig.measure("leaks", leaks)

"""Faults of disk, clock, sound and light: rows 13, 25 to 28, 30, 31, 59."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import threading
import time
from pathlib import Path

from campaign.registry import Skip, row
from campaign.rig import WEB, Rig


@row(13, "the wall clock jumps by an hour, and back", "decisions go on", "FAULT = 0 times")
def wall_clock(rig: Rig) -> None:
    service = rig.start(seam="wall_clock")
    service.settle()
    began_s = time.monotonic()
    for jump_s in ("3600", "-3600", "0"):
        rig.control(f"jump {jump_s}")
        time.sleep(4)
    rig.measure("FAULT", rig.light.count(("orange", "red", "off"), began_s, time.monotonic()))
    rig.expect(service.process.poll() is None, "the service ended")


@row(26, "the sound device is missing", "the light goes on", "FAULT = 0 times", in_tests=True)
def no_sound(rig: Rig) -> None:
    sound = "feedback: {light: simulated, sound: {enabled: true, device: none-such}}\n"
    service = rig.start(rig.config(WEB + sound))
    service.settle()
    began_s = time.monotonic()
    time.sleep(3)
    rig.measure("FAULT", rig.light.count(("orange", "off"), began_s, time.monotonic()))


@row(
    25,
    "the light is unplugged: its file cannot be written for 75 s",
    "reported, works again",
    "reported <= 1 s; recovery <= 5 s",
)
def light_unplugged(rig: Rig) -> None:
    service = rig.start(seam="light")
    service.settle()
    rig.control("unplugged")
    rig.measure("reported", service.until_health(lambda health: not health["light"]["ok"], 20))
    time.sleep(75)
    back_s = rig.control()
    service.until_health(lambda health: health["light"]["ok"], 60)
    rig.measure("recovery", time.monotonic() - back_s)


@row(
    27,
    "red and green lit at once, by another's hand",
    "the lamp shows FAULT and latches",
    "FAULT <= 0.5 s; cleared by itself = 0 times",
)
def two_lamps(rig: Rig) -> None:
    config = rig.lamp_config()
    state = rig.folder / "lamps"
    rig.start(config).settle()
    text = "red\ngreen\n"
    began_s = rig.fault(lambda: state.write_text(text), wait_s=10)
    time.sleep(15)
    rig.measure("cleared by itself", rig.light.count(("green", "blue"), began_s + 1, began_s + 15))


@row(
    28,
    "the heartbeat flickers: 200 ms without, 100 ms with, again and again",
    "recurrent fault",
    "trips <= 3 s; SAFE shown after = 0 times",
)
def flickering_heartbeat(rig: Rig) -> None:
    service = rig.start(rig.lamp_config())
    service.settle()
    ends = threading.Event()

    def flicker() -> None:
        while not ends.is_set():
            service.process.send_signal(signal.SIGSTOP)
            time.sleep(0.2)
            service.process.send_signal(signal.SIGCONT)
            time.sleep(0.1)

    began_s = time.monotonic()
    thread = threading.Thread(target=flicker, daemon=True)
    thread.start()
    rig.measure("trips", rig.light.until(("orange",), began_s, 10))
    time.sleep(22)
    ends.set()
    thread.join()
    shown = rig.light.count(("green", "blue"), began_s + 4, time.monotonic())
    rig.measure("SAFE shown after", shown)


@row(30, "the disk is full, then read-only", "decisions go on; reported", "FAULT = 0 times")
def full_disk(rig: Rig) -> None:
    disk = rig.folder / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], check=False,
                      capture_output=True).returncode:  # fmt: skip
        raise Skip("needs the right to mount a small file system")
    rig.callback(subprocess.run, ["umount", "-l", str(disk)])
    audit = f"audit: {{path: {disk}/audit.jsonl, min_free_mb: 0}}\n"
    service = rig.start(rig.config(WEB + audit))
    service.settle()
    began_s = time.monotonic()
    (disk / "filler").write_bytes(bytes(900_000))
    told_s = service.until_health(lambda health: "audit" in str(health["faults"]), 40)
    rig.expect(told_s < 40, "a full disk is not reported")
    (disk / "filler").unlink()
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=False, capture_output=True)
    time.sleep(4)
    rig.measure("FAULT", rig.light.count(("orange", "off"), began_s, time.monotonic()))


@row(
    59,
    "power cut while logs are written: 2,084 zero bytes at the end of audit.jsonl",
    "cut to the last whole record, and named",
    "lines that cannot be read = 0",
)
def zero_tail(rig: Rig) -> None:
    audit = rig.folder / "audit.jsonl"
    config = rig.config(WEB + f"audit: {{path: {audit}, min_free_mb: 0}}\n")
    service = rig.start(config)
    service.settle()
    time.sleep(1)
    service.process.kill()
    service.wait()
    with audit.open("ab") as file:
        file.write(b'{"frame": 12' + bytes(2084))
    again = rig.start(config)
    again.settle()
    time.sleep(1)
    again.stop()
    bad = sum(not _is_json(line) for line in audit.read_bytes().split(b"\n") if line)
    rig.measure("lines that cannot be read", bad)
    rig.expect("audit" in again.log, "the cut is not named in the log")


def _is_json(line: bytes) -> bool:
    with contextlib.suppress(ValueError):
        json.loads(line)
        return True
    return False


@row(
    31, "soak: ten minutes, extrapolated", "bounded", "memory growth <= 5 %; descriptors gained = 0"
)
def soak(rig: Rig) -> None:
    length_s = float(os.environ.get("BIKEPED_SOAK_S", "600"))
    service = rig.start()
    service.settle()
    time.sleep(min(60.0, length_s / 4))
    process = Path(f"/proc/{service.process.pid}")

    def now() -> tuple[float, int]:
        service.health()
        time.sleep(2)  # the server's end of that connection is closed by then
        pages = int((process / "statm").read_text().split()[1])
        return pages * 4096 / 1e6, len(list((process / "fd").iterdir()))

    (before_mb, before_fd), began_s = now(), time.monotonic()
    while time.monotonic() - began_s < length_s:
        time.sleep(5)
        service.health()
    after_mb, after_fd = now()
    rig.measure("memory growth", 100 * (after_mb / before_mb - 1))
    rig.measure("descriptors gained", after_fd - before_fd)
    hours = (time.monotonic() - began_s) / 3600
    rig.saw(
        f"{(after_mb - before_mb) / hours:+.1f} MB an hour over {hours:.2f} h, {before_mb:.0f} MB"
    )

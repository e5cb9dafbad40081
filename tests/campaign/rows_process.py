"""Faults of the process and of the machine below it: rows 19, 22 to 24, 45 to 47, 50, 51, 60."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import threading
import time
from typing import Any

from campaign.registry import row
from campaign.rig import WEB, Rig
from campaign.rows_network import mqtt_config

REASSURING = ("green", "blue")


def _is_slow(health: dict[str, Any]) -> bool:
    return bool({"service.slow", "camera.slow"} & set(health["fault_codes"]))


@row(19, "a throttled processor: runs 4 of 160 ms", "degraded", "declared <= 2 s", repeat=3)
def throttled(rig: Rig) -> None:
    service = rig.start()
    service.settle()
    ends = threading.Event()

    def throttle() -> None:
        while not ends.is_set():
            os.kill(service.process.pid, signal.SIGSTOP)
            time.sleep(0.156)
            os.kill(service.process.pid, signal.SIGCONT)
            time.sleep(0.004)

    for _ in rig.repetitions:
        ends.clear()
        thread = threading.Thread(target=throttle, daemon=True)
        thread.start()
        began_s = time.monotonic()
        rig.measure("declared", service.until_health(_is_slow, 6))
        time.sleep(2)
        ends.set()
        thread.join()
        changes = rig.light.count(REASSURING, began_s, time.monotonic())
        rig.expect(changes <= 1, f"FAULT flips with SAFE {changes} times")
        rig.ready(time.monotonic(), name=None)


@row(
    22,
    "SIGKILL of the service",
    "the light shows FAULT without it; a fresh start",
    "FAULT <= 1 s; restart <= 10 s",
    repeat=20,
    in_tests=True,
)
def killed(rig: Rig) -> None:
    supervisor = rig.supervise(rig.lamp_config())
    rig.ready(supervisor.began_s, name=None)
    for _ in rig.repetitions:
        process = supervisor.process
        assert process is not None
        began_s = rig.fault(process.kill, wait_s=20)
        rig.not_reassuring(began_s + 1, supervisor.next_start(began_s))
        rig.measure("restart", supervisor.next_start(began_s) - began_s)
        supervisor.as_after_an_hour()
        rig.ready(began_s + 1, name=None)


@row(
    23,
    "SIGSTOP; the interpreter held for 6 s",
    "the light shows FAULT without it; a fresh start",
    "FAULT <= 1 s; restart <= 10 s",
    repeat=5,
)
def stopped(rig: Rig) -> None:
    supervisor = rig.supervise(rig.lamp_config(), seam="interpreter")
    rig.ready(supervisor.began_s, name=None)
    for number in rig.repetitions:
        process = supervisor.process
        assert process is not None
        if number % 2:
            began_s = rig.fault(lambda: rig.control("hold 6"), wait_s=20)
            time.sleep(6)
            rig.not_reassuring(began_s + 1, began_s + 6)
        else:
            stop = process
            began_s = rig.fault(lambda: stop.send_signal(signal.SIGSTOP), wait_s=20)  # noqa: B023
            again_s = supervisor.next_start(began_s)
            rig.measure("restart", again_s - began_s)
            rig.not_reassuring(began_s + 1, again_s)
        supervisor.as_after_an_hour()
        rig.ready(time.monotonic(), name=None)


@row(
    24,
    "the service crashes ten times, as soon as it answers",
    "FAULT is held",
    "green or blue after the second crash = 0 times",
)
def crash_loop(rig: Rig) -> None:
    rig.control("later-kill 1.5")
    supervisor = rig.supervise(rig.lamp_config(), seam="detector")
    while len(supervisor.ends) < 10 and time.monotonic() - supervisor.began_s < 900:
        time.sleep(0.2)
    ends = [at_s for at_s, _ in supervisor.ends]
    if rig.expect(len(ends) >= 10, f"only {len(ends)} crashes"):
        shown = rig.light.count(REASSURING, ends[1], ends[9])
        rig.measure("green or blue after the second crash", shown)


@row(
    45,
    "standard error blocks: it has no reader",
    "the light goes on; FAULT when it is due",
    "FAULT <= 1 s",
    repeat=5,
)
def log_blocks(rig: Rig) -> None:
    for _ in rig.repetitions:
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        fcntl.fcntl(writer, 1031, 4096)  # F_SETPIPE_SZ
        began_s = time.monotonic()
        os.set_blocking(writer, True)
        process = rig.popen("run", "-c", rig.lamp_config(), stderr=writer, stdout=writer)
        os.set_blocking(writer, False)
        drained = threading.Thread(target=_drain, args=(reader, rig, began_s), daemon=True)
        drained.start()
        rig.ready(began_s, name=None)
        drained.join()
        for size in (512, 1):  # fill it to the brim
            with contextlib.suppress(BlockingIOError):
                while True:
                    os.write(writer, b"x" * size)
        os.set_blocking(writer, True)
        time.sleep(1)
        unplugged_s = rig.fault(rig.camera.unplug)
        time.sleep(2)
        rig.not_reassuring(unplugged_s + 1)
        process.kill()
        process.wait()
        rig.camera.plug()
        os.close(reader)
        os.close(writer)


def _drain(reader: int, rig: Rig, began_s: float) -> None:
    """Reads until the light reassures."""
    os.set_blocking(reader, False)
    while rig.light.until(REASSURING, began_s, 0.02) > 60 and time.monotonic() - began_s < 60:
        with contextlib.suppress(BlockingIOError):
            os.read(reader, 65536)
        time.sleep(0.01)


@row(
    46,
    "the configuration is overwritten with a broken one, then SIGKILL",
    "FAULT, then the last good configuration, and says so",
    "FAULT <= 1 s; ready <= 30 s",
    repeat=3,
)
def broken_configuration(rig: Rig) -> None:
    config = rig.lamp_config()
    good = config.read_text()
    supervisor = rig.supervise(config)
    rig.ready(supervisor.began_s, name=None)
    deadline_s = time.monotonic() + 180
    while "kept in" not in supervisor.log.read_text() and time.monotonic() < deadline_s:
        time.sleep(0.2)
    for _ in rig.repetitions:
        config.write_text(good[: len(good) // 2] + "\n  nonsense: [\n")
        process = supervisor.process
        assert process is not None
        began_s = rig.fault(process.kill, wait_s=20)
        rig.ready(began_s + 1.0)
        said = supervisor.log.read_text(errors="replace")
        rig.expect("last good" in said.lower(), "the log does not name the last good configuration")
        config.write_text(good)
        supervisor.as_after_an_hour()


@row(
    47,
    "SIGHUP, USR1, USR2, ALRM, QUIT",
    "HUP is ignored or reloads; the others leave no green light",
    "green after the end <= 1 s",
    repeat=2,
)
def signals(rig: Rig) -> None:
    for _ in rig.repetitions:
        for number in (
            signal.SIGHUP,
            signal.SIGUSR1,
            signal.SIGUSR2,
            signal.SIGALRM,
            signal.SIGQUIT,
        ):
            service = rig.start()
            service.settle()
            service.process.send_signal(number)
            began_s = time.monotonic()
            time.sleep(3)
            if service.process.poll() is None:
                rig.measure("green after the end", 0.0)
            else:
                shown_s = rig.light.reassured_s(began_s, time.monotonic())
                rig.measure("green after the end", shown_s)
                rig.expect(number != signal.SIGHUP, "SIGHUP ends the service")
                rig.expect(shown_s < 1, f"{number.name} ends it with the light green")
            service.close()


@row(50, "GPIO chip or lamp absent at the start", "FAULT, healthz 503", "healthz 200 = 0 times")
def no_light(rig: Rig) -> None:
    light = "feedback: {light: gpio, gpio: {chip: none-such, red: 1, green: 3, blue: 4}}\n"
    service = rig.start(rig.config(WEB + light))
    service.until_said("light: ")
    time.sleep(4)
    status, health = service.health()
    rig.saw(f"healthz {status}, {health['state']}")
    rig.measure("healthz 200", float(status == 200))
    rig.expect(health["state"] == "FAULT", f"the state is {health['state']}")


@row(
    51,
    "two services of one configuration; two sites of one name at one broker",
    "the second is refused and names the first; the broker's is noticed",
    "both run = 0 times; noticed <= 20 s",
    repeat=3,
)
def two_services(rig: Rig) -> None:
    first = rig.start()
    first.settle()
    for _ in rig.repetitions:
        second = rig.start(rig.folder / "pole.yaml")
        ended = _ends_within(second.process, 30)
        rig.measure("both run", float(not ended))
        rig.expect(str(first.process.pid) in second.log, "the second does not name the first's pid")
        second.close()
    first.close()
    _two_sites(rig)


def _two_sites(rig: Rig) -> None:
    """Two poles of one name, told apart by their health; neither throws the other off."""
    broker = rig.broker()
    lines = "  site: pole\n"
    poles = [
        rig.start(mqtt_config(rig, broker.port, lines, name=f"pole{number}.yaml"))
        for number in (1, 2)
    ]
    for pole in poles:
        pole.settle()
    for pole in poles:
        waited_s = pole.until_health(lambda h: "service.same_site" in h["fault_codes"], 20)
        rig.measure("noticed", waited_s)
    time.sleep(3)
    log = (broker.directory / "mosquitto.log").read_text(errors="replace")
    rig.expect("already connected" not in log, "one throws the other off the broker")


def _ends_within(process: subprocess.Popen[str], seconds: float) -> bool:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return False
    return True


@row(
    60,
    "doctor beside the running service",
    "answers; touches nothing that the service holds",
    "answer <= 20 s; light changes = 0",
    repeat=3,
)
def doctor(rig: Rig) -> None:
    service = rig.start()
    service.settle()
    for _ in rig.repetitions:
        began_s = time.monotonic()
        try:
            rig.bikeped("doctor", "-c", rig.folder / "pole.yaml", timeout_s=100)
        except subprocess.TimeoutExpired:
            rig.expect(False, "no answer in 100 s")
        ended_s = time.monotonic()
        rig.measure("answer", ended_s - began_s)
        changes = rig.light.count(("orange", "off", "red"), began_s, ended_s)
        rig.measure("light changes", changes)
    rig.expect(service.process.poll() is None, "the service ended")

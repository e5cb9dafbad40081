"""The light driver: blinking, watchdog, errors and a device that hangs; time is injected."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import pytest

from bikeped.config.output_sections import FeedbackConfig, GpioConfig, LampConfig, UsbConfig
from bikeped.errors import FeedbackError
from bikeped.faults import Fault
from bikeped.feedback import check_light, light_output, open_light
from bikeped.feedback.light import LightDriver, SimulatedLight
from bikeped.lamp.colours import assign_lamps
from bikeped.types import Colour, Signal

BLUE = Signal("IDLE", Colour.BLUE)
GREEN = Signal("SAFE", Colour.GREEN)
ALERT = Signal("ALERT", Colour.RED, 2.0)
FAULT_HZ = 0.5
WAIT_S = 20.0


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class FakeLight:
    """Notes every call; fails while `broken`."""

    def __init__(self) -> None:
        self.calls: list[Colour | str] = []
        self.broken = False
        self.opened = 0
        self.seen = threading.Condition()

    def open(self) -> FakeLight:
        if self.broken:
            raise FeedbackError("not plugged in")
        self.opened += 1
        return self

    def set(self, colour: Colour) -> None:
        if self.broken:
            raise FeedbackError("unplugged")
        self._note(colour)

    def close(self) -> None:
        if self.broken:
            raise FeedbackError("unplugged")
        self._note("close")

    def _note(self, call: Colour | str) -> None:
        with self.seen:
            self.calls.append(call)
            self.seen.notify_all()

    def wait_for(self, condition: Callable[[], bool]) -> None:
        with self.seen:
            assert self.seen.wait_for(condition, WAIT_S), f"only {self.calls}"


def make(light: FakeLight | None = None, **settings: float) -> tuple[LightDriver, FakeLight, Clock]:
    light, clock = light or FakeLight(), Clock()
    watchdog_s = settings.pop("watchdog_s", 1.0)
    driver = tuned(**settings)(
        light.open, fault_blink_hz=FAULT_HZ, watchdog_s=watchdog_s, clock=clock
    )
    return driver, light, clock


def tuned(**settings: object) -> type[LightDriver]:
    """The driver with other times."""
    return type("Tuned", (LightDriver,), settings)


def run(driver: LightDriver, clock: Clock, until_s: float, signal: Signal | None) -> None:
    """Steps the driver at the times it asks for, refreshing `signal` at each step if given."""
    while True:
        if signal is not None:
            driver.show(signal)
        wake_s = driver.update(clock.now_s)
        assert wake_s > clock.now_s, "the driver would spin"
        if wake_s > until_s:
            clock.now_s = until_s
            return
        clock.now_s = wake_s


class Relays(FakeLight):
    """Relays that can be read back; `other` is a lamp that another hand has lit."""

    other: Colour | None = None

    def mismatch(self, colour: Colour) -> str | None:
        return None if self.other is None else f"{colour.value} and {self.other.value} are lit"


def test_what_is_read_back_otherwise_latches_when_it_lasts() -> None:
    relays = Relays()
    driver, _, clock = make(relays)
    run(driver, clock, clock.now_s + 1, GREEN)
    relays.other = Colour.RED
    run(driver, clock, clock.now_s + 0.25, GREEN)
    relays.other = None
    run(driver, clock, clock.now_s + 1, GREEN)
    assert driver.fault is None
    assert Colour.ORANGE not in relays.calls
    relays.other = Colour.RED
    run(driver, clock, clock.now_s + 0.5, GREEN)
    relays.other, relays.calls = None, []
    run(driver, clock, clock.now_s + 60, GREEN)
    assert driver.fault is not None
    assert driver.fault.code == "lamp.latched"
    assert "green and red are lit" in driver.fault.detail
    assert set(relays.calls) == {Colour.ORANGE, Colour.OFF}


def test_shows_a_steady_colour_once_and_asserts_it_again() -> None:
    driver, light, clock = make(assert_s=2.0)
    run(driver, clock, clock.now_s + 5, BLUE)
    assert light.calls == [Colour.BLUE] * 3


def test_blinks_at_the_signals_rate_starting_lit() -> None:
    driver, light, clock = make(assert_s=100.0)
    start_s = clock.now_s
    run(driver, clock, start_s + 1.99, ALERT)
    assert light.calls == [Colour.RED, Colour.OFF] * 4


def test_a_new_pattern_starts_lit_at_once() -> None:
    driver, light, clock = make(assert_s=100.0)
    run(driver, clock, clock.now_s + 0.3, ALERT)
    assert light.calls == [Colour.RED, Colour.OFF]
    driver.show(GREEN)
    driver.update(clock.now_s)
    driver.show(ALERT)
    driver.update(clock.now_s)
    assert light.calls == [Colour.RED, Colour.OFF, Colour.GREEN, Colour.RED]


def test_shows_fault_before_the_first_signal(caplog: pytest.LogCaptureFixture) -> None:
    driver, light, clock = make(assert_s=100.0)
    run(driver, clock, clock.now_s + 3.9, None)
    assert light.calls == [Colour.ORANGE, Colour.OFF] * 2
    assert caplog.text.count("not refreshed") == 0


def test_the_watchdog_turns_a_stuck_green_into_fault_and_back(
    caplog: pytest.LogCaptureFixture,
) -> None:
    driver, light, clock = make(watchdog_s=1.0, assert_s=100.0)
    driver.show(GREEN)
    start_s = clock.now_s
    assert driver.update(start_s) == start_s + 1.0
    driver.update(start_s + 0.99)
    assert light.calls == [Colour.GREEN]
    clock.now_s = start_s + 1.0
    driver.update(clock.now_s)
    assert light.calls == [Colour.GREEN, Colour.ORANGE]
    assert caplog.text.count("not refreshed") == 1
    run(driver, clock, start_s + 10, None)
    assert light.calls[1:] == [Colour.ORANGE, Colour.OFF] * 5
    assert caplog.text.count("not refreshed") == 1
    driver.show(GREEN)
    driver.update(clock.now_s)
    assert light.calls[-1] is Colour.GREEN


def test_an_error_is_reported_retried_with_growing_pauses_and_mended() -> None:
    driver, light, clock = make(retry_s=(0.5, 2.0), assert_s=100.0)  # type: ignore[arg-type]
    light.broken = True
    start_s, tries_s = clock.now_s, []
    while len(tries_s) < 5:
        driver.show(BLUE)
        before = driver.errors
        wake_s = driver.update(clock.now_s)
        if driver.errors > before:
            tries_s.append(clock.now_s - start_s)
        clock.now_s = wake_s
    assert tries_s == [0.0, 0.5, 1.5, 3.5, 5.5]
    assert driver.fault == Fault("light", "light.error", "not plugged in")
    light.broken = False
    run(driver, clock, clock.now_s + 2, BLUE)
    assert driver.fault is None
    assert light.calls == [Colour.BLUE]


def test_an_unplugged_steady_light_is_noticed_and_reopened() -> None:
    driver, light, clock = make(assert_s=2.0)
    run(driver, clock, clock.now_s + 1, GREEN)
    light.broken = True
    run(driver, clock, clock.now_s + 3, GREEN)
    assert driver.fault is not None
    light.broken = False
    run(driver, clock, clock.now_s + 40, GREEN)
    assert light.opened == 2
    assert light.calls[-1] is Colour.GREEN
    assert driver.fault is None


def test_a_bug_in_a_device_is_a_fault_like_any_other() -> None:
    light = FakeLight()
    light.set = lambda colour: [][0]  # type: ignore[method-assign]
    driver, _, clock = make(light)
    driver.show(BLUE)
    driver.update(clock.now_s)
    assert str(driver.fault) == "light: IndexError: list index out of range"


def test_the_thread_shows_signals_and_close_darkens() -> None:
    light = FakeLight()
    driver = LightDriver(light.open, watchdog_s=600.0)
    driver.start()
    light.wait_for(lambda: Colour.ORANGE in light.calls)
    driver.show(GREEN)
    light.wait_for(lambda: Colour.GREEN in light.calls)
    driver.show(ALERT)
    light.wait_for(lambda: light.calls.count(Colour.RED) >= 2)
    assert driver.close(WAIT_S)
    assert light.calls[-1] == "close"
    assert driver.fault is None


def test_the_threads_watchdog_needs_no_help_from_the_loop(caplog: pytest.LogCaptureFixture) -> None:
    light = FakeLight()
    driver = LightDriver(light.open, watchdog_s=0.05, fault_blink_hz=10.0)
    driver.start()
    driver.show(GREEN)
    light.wait_for(lambda: Colour.GREEN in light.calls)
    light.wait_for(lambda: light.calls.count(Colour.ORANGE) >= 2)
    driver.close(WAIT_S)
    assert caplog.text.count("not refreshed") == 1


def test_a_hanging_device_blocks_nobody_and_is_a_fault() -> None:
    entered, release = threading.Event(), threading.Event()

    class Hanging(FakeLight):
        def set(self, colour: Colour) -> None:
            entered.set()
            release.wait(WAIT_S)

    clock = Clock()
    driver = LightDriver(Hanging().open, clock=clock)
    driver.start()
    assert entered.wait(WAIT_S)
    driver.show(GREEN)
    assert driver.fault is None
    clock.now_s += 2.1
    assert str(driver.fault) == "light: the device has not answered for more than 2 s"
    assert driver.fault.code == "light.hang"
    assert not driver.close(0.01)
    release.set()
    assert driver.close(WAIT_S)


def test_closing_tries_once_more_to_darken_a_light_that_failed() -> None:
    light = FakeLight()
    light.broken = True
    failed = threading.Event()

    class Tells(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            failed.set()

    handler = Tells(logging.ERROR)
    logging.getLogger("bikeped.feedback.light").addHandler(handler)
    try:
        driver = tuned(retry_s=(600.0, 600.0))(light.open)
        driver.start()
        assert failed.wait(WAIT_S)
    finally:
        logging.getLogger("bikeped.feedback.light").removeHandler(handler)
    light.broken = False
    assert driver.close(WAIT_S)
    assert light.calls == [Colour.OFF, "close"]


def test_starts_only_once_and_closes_without_a_start() -> None:
    driver, _, _ = make()
    assert driver.close()
    started = LightDriver(FakeLight().open)
    started.start()
    with pytest.raises(RuntimeError, match="once"):
        started.start()
    started.close(WAIT_S)


def test_simulated_light_logs_colours_but_not_every_flash(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    light = SimulatedLight()
    for _ in range(50):
        light.set(Colour.RED)
        light.set(Colour.OFF)
    light.set(Colour.BLUE)
    assert [record.message for record in caplog.records] == [
        "simulated light: red",
        "simulated light: blue",
    ]
    light.close()
    assert light.colour is Colour.OFF


def test_orange_falls_back_to_red_and_the_calm_colours_to_dark() -> None:
    lamps = assign_lamps({Colour.RED: 7}, "feedback.gpio")
    assert lamps == {
        Colour.RED: 7,
        Colour.ORANGE: 7,
        Colour.GREEN: None,
        Colour.BLUE: None,
        Colour.OFF: None,
    }


@pytest.mark.parametrize(
    ("wired", "message"),
    [
        ({Colour.GREEN: 1, Colour.ORANGE: 2}, "feedback.x: no red lamp"),
        ({Colour.RED: 1, Colour.GREEN: 1}, "feedback.x: red and green are both on 1"),
        ({}, "no red lamp"),
    ],
)
def test_wiring_that_could_mislead_is_refused(wired: dict[Colour, int], message: str) -> None:
    with pytest.raises(FeedbackError, match=message):
        assign_lamps(dict(wired), "feedback.x")


def test_factories_check_the_wiring_before_any_device() -> None:
    for bad in (
        FeedbackConfig(light="gpio", gpio=GpioConfig(green=1)),
        FeedbackConfig(light="usb", usb=UsbConfig(relay_red=0)),
        FeedbackConfig(light="usb", usb=UsbConfig(relay_green=1)),
    ):
        with pytest.raises(FeedbackError, match=r"feedback\.(gpio|usb)"):
            check_light(bad, LampConfig())
        with pytest.raises(FeedbackError, match=r"feedback\.(gpio|usb)"):
            light_output(bad, LampConfig())
    assert isinstance(open_light(FeedbackConfig()), SimulatedLight)
    blink1 = FeedbackConfig(light="usb", usb=UsbConfig(device="blink1", relay_red=0))
    check_light(blink1, LampConfig())

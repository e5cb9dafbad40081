"""GPIO lamps against a fake of the gpiod 2 bindings, and against the real bindings' API."""

from __future__ import annotations

import enum
import inspect
from types import SimpleNamespace
from typing import Any

import gpiod
import pytest

from bikeped.config.output_sections import GpioConfig
from bikeped.errors import FeedbackError
from bikeped.lamp.gpio import GpioLight
from bikeped.types import Colour

FOUR = GpioConfig(red="PQ.05", orange=106, green="PN.01", blue="PAC.06")


class Direction(enum.Enum):
    OUTPUT = 1


class Value(enum.Enum):
    INACTIVE = 0
    ACTIVE = 1


class FakeGpiod:
    """One or more chips with named lines; notes each request and each change of the lamps."""

    def __init__(self, **chips: str) -> None:
        self.chips = {f"/dev/{name}": label for name, label in chips.items()}
        self.line = SimpleNamespace(Direction=Direction, Value=Value)
        self.names = {"PQ.05": 105, "PN.01": 85, "PAC.06": 144}
        self.requests: list[dict[str, Any]] = []
        self.lit: dict[str | int, Value] = {}
        self.history: list[frozenset[str | int]] = []
        self.busy = False
        self.fail = False
        self.released = 0
        self.open_chips = 0

    def is_gpiochip_device(self, path: str) -> bool:
        return path in self.chips

    def LineSettings(self, **settings: Any) -> dict[str, Any]:  # noqa: N802 - gpiod's name
        return settings

    def Chip(self, path: str) -> FakeChip:  # noqa: N802 - gpiod's name
        if path not in self.chips:
            raise FileNotFoundError(2, "No such file or directory", path)
        return FakeChip(self, path)


class FakeChip:
    def __init__(self, gpiod: FakeGpiod, path: str) -> None:
        self.gpiod, self.path = gpiod, path

    def __enter__(self) -> FakeChip:
        self.gpiod.open_chips += 1
        return self

    def __exit__(self, *_: object) -> None:
        self.gpiod.open_chips -= 1

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(name=self.path[5:], label=self.gpiod.chips[self.path], num_lines=164)

    def line_offset_from_id(self, line: str | int) -> int:
        if isinstance(line, int):
            if line >= 164:
                raise ValueError("line offset of out range")
            return line
        if line not in self.gpiod.names:
            raise FileNotFoundError(2, "No such file or directory")
        return self.gpiod.names[line]

    def request_lines(self, config: dict[Any, Any], consumer: str) -> FakeRequest:
        if self.gpiod.busy:
            raise OSError(16, "Device or resource busy")
        self.gpiod.requests.append({"path": self.path, "consumer": consumer, "config": config})
        for lines, settings in config.items():
            for line in lines:
                self.gpiod.lit[line] = settings["output_value"]
        return FakeRequest(self.gpiod)


class FakeRequest:
    def __init__(self, gpiod: FakeGpiod) -> None:
        self.gpiod = gpiod

    def set_values(self, values: dict[str | int, Value]) -> None:
        if self.gpiod.fail:
            raise OSError(5, "Input/output error")
        self.gpiod.lit.update(values)
        self.gpiod.history.append(
            frozenset(line for line, value in self.gpiod.lit.items() if value is Value.ACTIVE)
        )

    def release(self) -> None:
        self.gpiod.released += 1


def orin() -> FakeGpiod:
    return FakeGpiod(gpiochip0="tegra234-gpio", gpiochip1="tegra234-gpio-aon")


def open_on(fake: FakeGpiod, config: GpioConfig = FOUR) -> GpioLight:
    return GpioLight(config, gpiod=fake, chips=[*fake.chips, "/dev/gpiochip-odd"])


def test_requests_all_lines_as_dark_outputs_under_its_name() -> None:
    fake = orin()
    open_on(fake)
    (request,) = fake.requests
    assert request["path"] == "/dev/gpiochip0"
    assert request["consumer"] == "bikeped"
    ((lines, settings),) = request["config"].items()
    assert set(lines) == {"PQ.05", 106, "PN.01", "PAC.06"}
    assert settings == {
        "direction": Direction.OUTPUT,
        "active_low": False,
        "output_value": Value.INACTIVE,
    }
    assert fake.open_chips == 0


@pytest.mark.parametrize("chip", ["tegra234-gpio-aon", "gpiochip1", "/dev/gpiochip1"])
def test_finds_the_chip_by_label_name_or_path(chip: str) -> None:
    fake = orin()
    open_on(fake, GpioConfig(chip=chip, red=3, active_low=True))
    assert fake.requests[0]["path"] == "/dev/gpiochip1"
    assert fake.requests[0]["config"][(3,)]["active_low"] is True


def test_two_lamps_never_show_at_once() -> None:
    fake = orin()
    light = open_on(fake)
    order = [Colour.RED, Colour.GREEN, Colour.OFF, Colour.ORANGE, Colour.BLUE, Colour.RED]
    ends = []
    for colour in order:
        light.set(colour)
        ends.append(fake.history[-1])
    assert ends == [{"PQ.05"}, {"PN.01"}, set(), {106}, {"PAC.06"}, {"PQ.05"}]
    assert max(len(lit) for lit in fake.history) == 1


def test_showing_a_colour_again_does_not_flicker() -> None:
    fake = orin()
    light = open_on(fake)
    light.set(Colour.GREEN)
    fake.history.clear()
    light.set(Colour.GREEN)
    assert set(fake.history) == {frozenset({"PN.01"})}


def test_without_an_orange_lamp_red_takes_its_signals() -> None:
    fake = orin()
    light = open_on(fake, GpioConfig(red=1, green=2))
    shown = []
    for colour in (Colour.ORANGE, Colour.BLUE, Colour.GREEN):
        light.set(colour)
        shown.append(fake.history[-1])
    assert shown == [{1}, set(), {2}]


def test_one_lamp_alone_is_enough() -> None:
    fake = orin()
    light = open_on(fake, GpioConfig(red=1))
    light.set(Colour.RED)
    light.set(Colour.GREEN)
    assert fake.history == [{1}, set()]


def test_close_darkens_and_releases_even_when_the_device_fails() -> None:
    fake = orin()
    light = open_on(fake)
    light.set(Colour.GREEN)
    light.close()
    assert fake.history[-1] == set()
    assert fake.released == 1
    fake.fail = True
    with pytest.raises(FeedbackError, match="off cannot be set"):
        open_on(fake).close()
    assert fake.released == 2


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (GpioConfig(green=1), r"feedback\.gpio: no red lamp"),
        (GpioConfig(red=1, chip="nowhere"), r"gpio\.chip: .*'nowhere'.*gpiochip0 \[tegra234-gpio"),
        (GpioConfig(red=1, chip="/dev/gpiochip9"), "No such file"),
        (GpioConfig(red=1, green="PX.99"), r"feedback\.gpio\.green: .*no line 'PX\.99'"),
        (GpioConfig(red=900), r"feedback\.gpio\.red: .*no line 900"),
    ],
)
def test_errors_name_key_and_mend(config: GpioConfig, message: str) -> None:
    with pytest.raises(FeedbackError, match=message):
        open_on(orin(), config)


def test_a_label_that_fits_two_chips_is_refused() -> None:
    fake = FakeGpiod(gpiochip0="same", gpiochip1="same")
    with pytest.raises(FeedbackError, match="name one of them by its path"):
        open_on(fake, GpioConfig(red=1, chip="same"))


def test_lines_in_use_are_an_error_that_says_so() -> None:
    fake = orin()
    fake.busy = True
    with pytest.raises(FeedbackError, match=r"busy.*another program"):
        open_on(fake)


def test_a_failing_line_is_a_feedback_error() -> None:
    fake = orin()
    light = open_on(fake)
    fake.fail = True
    with pytest.raises(FeedbackError, match="red cannot be set"):
        light.set(Colour.RED)


def test_the_real_bindings_have_what_the_fake_has() -> None:
    chip = inspect.signature(gpiod.Chip.request_lines).parameters
    assert {"config", "consumer"} <= set(chip)
    settings = gpiod.LineSettings(
        direction=gpiod.line.Direction.OUTPUT,
        active_low=True,
        output_value=gpiod.line.Value.INACTIVE,
    )
    assert settings.active_low
    assert {"name", "label"} <= set(gpiod.ChipInfo.__dataclass_fields__)
    for name in ("set_values", "release"):
        assert callable(getattr(gpiod.LineRequest, name))
    assert callable(gpiod.Chip.line_offset_from_id)
    assert gpiod.line.Value.ACTIVE is not gpiod.line.Value.INACTIVE


def test_without_any_chip_the_real_bindings_give_our_error() -> None:
    with pytest.raises(FeedbackError, match=r"feedback\.gpio\.chip: .*present: none"):
        GpioLight(FOUR, chips=["/dev/null"])

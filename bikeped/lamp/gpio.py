"""A light whose lamps hang on GPIO lines, through the kernel's character device (libgpiod 2).

The API is that of the official Python bindings, https://libgpiod.readthedocs.io (`Chip`,
`LineSettings`, `request_lines`, `LineRequest.set_values`). Lines are requested as outputs that are
inactive from the first moment. When the request is let go, or the process dies, the kernel gives
the lines back and the pins return to their boot state: wire lamps so that this state is dark.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from bikeped.errors import FeedbackError
from bikeped.lamp.colours import LAMP_COLOURS, Colour, Lamp, assign_lamps

SECTION = "feedback.gpio"


class GpioWiring(Protocol):
    """What `feedback.gpio` says; the lamp's process has it without the configuration's classes."""

    @property
    def chip(self) -> str: ...
    @property
    def active_low(self) -> bool: ...


def gpio_lamps(config: GpioWiring) -> dict[Colour, Lamp]:
    """The line of each colour; raises FeedbackError when the wiring cannot show what it must."""
    return assign_lamps({c: getattr(config, c.value) for c in LAMP_COLOURS}, SECTION)


class GpioLight:
    """One lamp a colour, each on its own line of one chip.

    `gpiod` takes another module in place of libgpiod's bindings (tests); `chips` the chip devices
    to search in place of /dev/gpiochip*. Raises FeedbackError when the bindings, the chip or a line
    is missing, or a line is in use.
    """

    def __init__(
        self, config: GpioWiring, *, gpiod: Any = None, chips: Iterable[str] | None = None
    ) -> None:
        self._lamps = gpio_lamps(config)
        self._gpiod = _load_gpiod() if gpiod is None else gpiod
        self._lines = [line for line in dict.fromkeys(self._lamps.values()) if line is not None]
        value = self._gpiod.line.Value
        self._active, self._inactive = value.ACTIVE, value.INACTIVE
        settings = self._gpiod.LineSettings(
            direction=self._gpiod.line.Direction.OUTPUT,
            active_low=config.active_low,
            output_value=self._inactive,
        )
        path = _find_chip(self._gpiod, config.chip, chips)
        try:
            with self._gpiod.Chip(path) as chip:
                for colour, line in self._lamps.items():
                    if line is not None:
                        _check_line(chip, config.chip, colour, line)
                self._request = chip.request_lines(
                    config={tuple(self._lines): settings}, consumer="bikeped"
                )
        except (OSError, ValueError) as error:
            raise FeedbackError(
                f"{SECTION}: the lines {self._lines} of {config.chip} ({path}) cannot be driven: "
                f"{error}; is another program using them, and is this user in group gpio?"
            ) from error

    def set(self, colour: Colour) -> None:
        """Shows `colour`: the others go dark first, so two lamps never show at once."""
        lamp = self._lamps[colour]
        dark = {line: self._inactive for line in self._lines if line != lamp}
        try:
            if dark:
                self._request.set_values(dark)
            if lamp is not None:
                self._request.set_values({lamp: self._active})
        except (OSError, ValueError) as error:
            raise FeedbackError(f"{SECTION}: {colour.value} cannot be set: {error}") from error

    def mismatch(self, colour: Colour) -> str | None:
        """What the lines read back instead of `colour`; None where they agree."""
        try:
            values = self._request.get_values(self._lines)
        except (OSError, ValueError) as error:
            raise FeedbackError(f"{SECTION}: the lines cannot be read: {error}") from error
        lit = [
            line for line, value in zip(self._lines, values, strict=True) if value == self._active
        ]
        lamp = self._lamps[colour]
        return None if lit == ([] if lamp is None else [lamp]) else f"the lines {lit} are lit"

    def close(self) -> None:
        """Switches all lamps off and gives the lines back to the kernel."""
        try:
            self.set(Colour.OFF)
        finally:
            self._request.release()


def _load_gpiod() -> Any:
    try:
        module = importlib.import_module("gpiod")
        importlib.import_module("gpiod.line")
    except ImportError as error:
        raise FeedbackError(
            "feedback.light: gpio needs the Python package gpiod; install bikeped[gpio]"
        ) from error
    if not hasattr(module, "LineSettings"):
        # Ubuntu's python3-libgpiod is version 1 and has the same name.
        raise FeedbackError(
            "feedback.light: the gpiod that was found is version 1; install bikeped[gpio]"
        )
    return module


def _find_chip(gpiod: Any, wanted: str, chips: Iterable[str] | None) -> str:
    """The device path of the chip with this label, name or path."""
    if wanted.startswith("/"):
        return wanted
    if chips is None:
        chips = sorted(str(path) for path in Path("/dev").glob("gpiochip*"))
    seen, found = [], []
    for path in chips:
        if not gpiod.is_gpiochip_device(path):
            continue
        try:
            with gpiod.Chip(path) as chip:
                info = chip.get_info()
        except OSError as error:
            seen.append(f"{path} ({error})")
            continue
        seen.append(f"{info.name} [{info.label}]")
        if wanted in (info.name, info.label):
            found.append(path)
    if len(found) == 1:
        return found[0]
    problem = f"no chip has the label or name {wanted!r}; present: {', '.join(seen) or 'none'}"
    if found:
        problem = f"{wanted!r} fits {', '.join(found)}; name one of them by its path"
    raise FeedbackError(f"{SECTION}.chip: {problem}")


def _check_line(chip: Any, chip_name: str, colour: Colour, line: str | int) -> None:
    try:
        chip.line_offset_from_id(line)
    except (OSError, ValueError) as error:
        raise FeedbackError(
            f"{SECTION}.{colour.value}: {chip_name} has no line {line!r}; `gpioinfo` lists them"
        ) from error

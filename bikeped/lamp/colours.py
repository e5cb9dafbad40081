"""Colours, lamps, and what a light as a device must do. Light: the lamp's process imports it."""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Mapping
from typing import Protocol

from bikeped.errors import FeedbackError

#: A GPIO line by name or offset, or a relay by number; None is not wired.
Lamp = str | int | None


class Colour(str, enum.Enum):
    """Colours of the light."""

    OFF = "off"
    BLUE = "blue"
    GREEN = "green"
    ORANGE = "orange"
    RED = "red"


LAMP_COLOURS = (Colour.RED, Colour.ORANGE, Colour.GREEN, Colour.BLUE)


class Light(Protocol):
    """A light as a device: one colour at a time.

    Both methods raise FeedbackError when the device does not obey; after that the light is closed
    and opened anew.
    """

    def set(self, colour: Colour) -> None:
        """Shows `colour` and nothing else; `Colour.OFF` is dark. May block."""

    def close(self) -> None:
        """Switches off and releases the device."""


def blinked(colour: Colour, blink_hz: float, since_s: float, now_s: float) -> tuple[Colour, float]:
    """The colour at `now_s` of a pattern that began at `since_s`, and when it changes next.

    Blinking is lit for the first half of each period, so a new pattern shows at once.
    """
    if blink_hz <= 0 or colour is Colour.OFF:
        return colour, math.inf
    half_s = 0.5 / blink_hz
    # The epsilon keeps a wake-up that comes right at an edge on the far side of it.
    half = int((now_s - since_s) / half_s + 1e-6)
    return (colour if half % 2 == 0 else Colour.OFF), since_s + (half + 1) * half_s


def assign_lamps(wired: Mapping[Colour, Lamp], section: str) -> dict[Colour, Lamp]:
    """Which lamp shows which colour, given the lamps that are wired; None is dark.

    Without an orange lamp its signals (WARNING, FAULT) go to red, which never reassures; green and
    blue fall back to dark. Raises FeedbackError, naming the configuration `section`, when red is
    missing (no ALERT could be shown) or two colours share a lamp.
    """
    lamps = {colour: wired.get(colour) for colour in LAMP_COLOURS}
    if lamps[Colour.RED] is None:
        raise FeedbackError(
            f"{section}: no red lamp is wired, so no ALERT could be shown; set the key of red"
        )
    for (one, lamp), (other, same) in itertools.combinations(lamps.items(), 2):
        if lamp is not None and lamp == same:
            raise FeedbackError(
                f"{section}: {one.value} and {other.value} are both on {lamp!r}; give each "
                "its own, or leave one out"
            )
    if lamps[Colour.ORANGE] is None:
        lamps[Colour.ORANGE] = lamps[Colour.RED]
    return {**lamps, Colour.OFF: None}

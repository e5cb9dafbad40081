"""The rows of the campaign: what is injected, what is expected, within which limits."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

#: Which later piece of work closes the rows that are not expected to pass yet.
EVIDENCE = "evidence"
WORLD = "the world as it comes"
HARDWARE = "the virtual pole (city)"

ROWS: dict[int, Row] = {}


@dataclass(frozen=True)
class Limit:
    """A figure that a row measures, and the bound that it must keep: `name relation value unit`."""

    name: str
    relation: str  #: <=, >= or =
    value: float
    unit: str

    @classmethod
    def parse(cls, text: str) -> Limit:
        """`FAULT <= 1 s`: ValueError for what does not read so."""
        match = re.fullmatch(r"\s*(.+?)\s*(<=|>=|=)\s*([\d.]+)\s*(\S.*?)?\s*", text)
        if match is None:
            raise ValueError(f"{text!r}: not a limit, such as 'FAULT <= 1 s'")
        return cls(match[1], match[2], float(match[3]), match[4] or "")

    def holds(self, measured: float) -> bool:
        """Whether `measured` keeps the bound; NaN never does."""
        if self.relation == "<=":
            return measured <= self.value
        return measured >= self.value if self.relation == ">=" else measured == self.value

    def worse(self, one: float, other: float) -> float:
        """The figure that is farther from the bound."""
        if self.relation == "=":
            return max(one, other, key=lambda value: abs(value - self.value))
        return max(one, other) if self.relation == "<=" else min(one, other)

    def __str__(self) -> str:
        return f"{self.name} {self.relation} {self.value:g} {self.unit}".rstrip()


@dataclass(frozen=True)
class Row:
    """One fault of the list; without a `function` nothing injects it, and `closed_by` says why."""

    number: int
    injected: str
    expected: str
    limits: tuple[Limit, ...]
    function: Callable[[Any], None] | None = None
    repeat: int = 1
    in_tests: bool = False
    closed_by: str = ""  #: empty: this campaign's own, which fails when the row fails


@dataclass
class Result:
    """What a row gave: the worst figure of each limit over all repetitions, and what was seen."""

    row: Row
    worst: dict[str, float] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    seen: list[str] = field(default_factory=list)
    repetitions: int = 0
    took_s: float = 0.0
    skipped: str = ""  #: why the row was not tried

    @property
    def verdict(self) -> str:
        """pass, fail or not tried."""
        if self.skipped or self.row.function is None:
            return "not tried"
        kept = all(
            limit.name in self.worst and limit.holds(self.worst[limit.name])
            for limit in self.row.limits
        )
        return "pass" if kept and not self.failures else "fail"

    @property
    def measured(self) -> str:
        """The worst figures, for the table."""
        units = {limit.name: limit.unit for limit in self.row.limits}
        return ", ".join(
            f"{name} {value:.3g} {units.get(name, '')}".rstrip()
            for name, value in self.worst.items()
        )


def row(
    number: int,
    injected: str,
    expected: str,
    limit: str,
    *,
    repeat: int = 1,
    in_tests: bool = False,
    closed_by: str = "",
) -> Callable[[Callable[[Any], None]], Callable[[Any], None]]:
    """Registers the function below as row `number`; `limit` reads `FAULT <= 1 s; ...`."""

    def register(function: Callable[[Any], None]) -> Callable[[Any], None]:
        add(Row(number, injected, expected, limits(limit), function, repeat, in_tests, closed_by))
        return function

    return register


def limits(text: str) -> tuple[Limit, ...]:
    """The limits of `FAULT <= 1 s; ready <= 5 s`."""
    return tuple(Limit.parse(part) for part in text.split(";"))


def add(new: Row) -> None:
    """Registers a row; ValueError where its number is taken."""
    if new.number in ROWS:
        raise ValueError(f"row {new.number} is registered twice")
    ROWS[new.number] = new


class Skip(Exception):  # noqa: N818 - no error
    """Raised by a row that cannot be tried on this machine; the text says what is missing."""

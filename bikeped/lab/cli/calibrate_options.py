"""What `bikeped calibrate` was asked for."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import click

from bikeped.errors import BikepedError
from bikeped.lab.calibration.board_view import BoardPattern

#: A board needs corners in two directions, and no printed one has more.
_FEWEST, _MOST = 3, 60


class _Pattern(click.ParamType):  # type: ignore[type-arg]
    name = "pattern"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,3})[xX×](\d{1,3})", str(value).strip())
        sides = (0, 0) if match is None else (int(match[1]), int(match[2]))
        if not all(_FEWEST <= side <= _MOST for side in sides):
            self.fail(
                f"{value!r} is no board: give the inner corners as COLUMNSxROWS, e.g. 8x6, each "
                f"from {_FEWEST} to {_MOST}",
                param,
                ctx,
            )
        return sides


PATTERN = _Pattern()


@dataclass(frozen=True)
class Asked:
    """Board and models; `model` and `terms` None: what --compare recommends, or the defaults."""

    columns: int
    rows: int
    square_m: float | None
    model: str | None
    terms: int | None
    board_shape: bool
    compare: bool
    folds: int

    @staticmethod
    def of(
        pattern: tuple[int, int] | None,
        square_m: float | None,
        model: str | None,
        terms: str | None,
        board_shape: bool,
        compare: bool,
        folds: int,
    ) -> Asked:
        """BikepedError when the board is not described."""
        if pattern is None:
            raise BikepedError(
                "--pattern: missing; count the corners where four squares meet and give "
                "COLUMNSxROWS, e.g. --pattern 8x6"
            )
        number = None if terms is None else int(terms)
        return Asked(*pattern, square_m, model, number, board_shape, compare, folds)

    @property
    def pattern(self) -> BoardPattern:
        """The board; squares of 1 where none were measured."""
        return BoardPattern(self.columns, self.rows, self.square_m or 1.0)

    @property
    def free_to_choose(self) -> bool:
        """Whether the recommended model is to be written."""
        open_model = self.model is None and self.terms is None and not self.board_shape
        return self.compare and open_model

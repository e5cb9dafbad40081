"""The board and the models that `bikeped calibrate` was given."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import click

from bikeped.lab.calibration.board_view import BoardPattern

#: A board needs corners in two directions, and no printed one has more.
_FEWEST, _MOST = 3, 60


class PatternType(click.ParamType):  # type: ignore[type-arg]
    """Inner corners as `COLUMNSxROWS`."""

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


@dataclass(frozen=True)
class CalibrateOptions:
    """Board and models; `model` and `terms` None: as `--compare` recommends, or the defaults."""

    pattern: BoardPattern
    model: str | None
    terms: int | None
    board_shape: bool
    compare: bool
    folds: int  #: 0: each image is a fold

    @property
    def writes_recommended(self) -> bool:
        """Whether the recommended model is written."""
        open_model = self.model is None and self.terms is None and not self.board_shape
        return self.compare and open_model

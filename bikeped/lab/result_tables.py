"""What an experiment leaves: data for machines and tables for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

CellValue = str | float | int | None


@dataclass(frozen=True)
class ResultTable:
    """One table: `name` is its file name, `rows` hold plain values (None: no figure)."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[CellValue, ...]]
    note: str = ""

    def csv(self) -> str:
        """The table as CSV with a header line; empty where there is no figure."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in self.rows:
            writer.writerow(
                ["" if v is None else repr(v) if isinstance(v, float) else v for v in row]
            )
        return out.getvalue()


@dataclass(frozen=True)
class ExperimentResult:
    """One experiment's outcome: `data` is plain JSON, `tables` say the same for people."""

    name: str
    data: dict[str, Any]
    tables: tuple[ResultTable, ...] = field(default=())

"""Results of experiments: data for machines and tables for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

CellValue = str | float | int | None


def cells(record: Mapping[str, Any], columns: Mapping[str, str]) -> tuple[CellValue, ...]:
    """The values of `record` at the keys of `columns` (column to key, `a.b` for nested ones).

    Shares become per cent with one decimal in columns that end in `%`, times get two decimals in
    columns that end in `, s`. None where a value is null or missing.
    """
    return tuple(_cell(record, column, key) for column, key in columns.items())


def _cell(record: Mapping[str, Any], column: str, key: str) -> CellValue:
    found: Any = record
    for part in key.split("."):
        found = None if found is None else found.get(part)
    value: CellValue = found
    if isinstance(value, (int, float)) and column.endswith("%"):
        return round(100 * value, 1)
    if isinstance(value, (int, float)) and column.endswith(", s"):
        return round(value, 2)
    return value


@dataclass(frozen=True)
class ResultTable:
    """One table: `name` is its file name, `rows` hold plain values (None: no value)."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[CellValue, ...]]
    note: str = ""

    @staticmethod
    def of(
        name: str,
        title: str,
        records: Iterable[Mapping[str, Any]],
        columns: Mapping[str, str],
        note: str = "",
    ) -> ResultTable:
        """A table with a row of `cells` for each record."""
        rows = [cells(record, columns) for record in records]
        return ResultTable(name, title, tuple(columns), rows, note)

    def without(self, column: str) -> ResultTable:
        """The table without one column."""
        index = self.columns.index(column)
        names, *rows = ((*row[:index], *row[index + 1 :]) for row in ((*self.columns,), *self.rows))
        return replace(self, columns=tuple(map(str, names)), rows=rows)

    def csv(self) -> str:
        """The table as CSV with a header line; empty where there is no value."""
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

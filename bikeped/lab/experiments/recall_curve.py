"""Recall curves from files: detector recall by projected area."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.errors import BikepedError
from bikeped.lab.simulation.perception import RecallCurve


def load_recall_curve(path: Path) -> RecallCurve:
    """Bin centres (square pixels at the network's input) and the recall of each bin.

    CSV with the two columns (a header is allowed), or JSON: a list of [centre, recall], or
    `{"area_px2": [...], "recall": [...]}`. BikepedError names the file and the remedy.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BikepedError(f"{path}: cannot be read; check --recall-curve") from error
    try:
        pairs = _json_pairs(text) if path.suffix == ".json" else _csv_pairs(text)
        values = np.asarray(pairs, np.float64).reshape(-1, 2)
    except (ValueError, TypeError, KeyError, RecursionError, csv.Error) as error:
        raise BikepedError(
            f"{path}: is not a recall curve; write lines of bin centre, recall"
        ) from error
    centre, recall = values[:, 0], values[:, 1]
    if len(values) < 2 or not np.isfinite(values).all() or not (np.diff(centre) > 0).all():
        raise BikepedError(f"{path}: bin centre: needs two or more finite centres that increase")
    if centre[0] < 0 or recall.min() < 0 or recall.max() > 1:
        raise BikepedError(f"{path}: recall: expected 0 to 1 at centres from 0; correct the values")
    return tuple(centre.tolist()), tuple(recall.tolist())


def _json_pairs(text: str) -> list[Any]:
    data = json.loads(text)
    if isinstance(data, dict):
        return list(zip(data["area_px2"], data["recall"], strict=True))
    return list(data)


def _csv_pairs(text: str) -> list[list[float]]:
    lines = [line for line in csv.reader(io.StringIO(text)) if line]
    if lines:
        try:
            float(lines[0][0])
        except ValueError:
            lines = lines[1:]  # a header
    return [[float(a), float(b)] for a, b in lines]

"""The board to print: squares of the size it says, a ruler, and a file that viewers can read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import BikepedError, CalibrationError
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.capture.board_pdf import PAGES, board_pdf, write_board_pdf
from bikeped.types import FloatArray

POINT_MM = 25.4 / 72


def squares(pdf: bytes) -> FloatArray:
    """[n, 4] x, y, width, height in millimetres of the filled rectangles."""
    found = re.findall(rb"([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+) re", pdf)
    return np.array(found, dtype=np.float64) * POINT_MM


def page_mm(pdf: bytes) -> tuple[float, float]:
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert box is not None
    return float(box[1]) * POINT_MM, float(box[2]) * POINT_MM


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 14), st.integers(3, 14), st.sampled_from(sorted(PAGES)))
def test_squares_are_exact_alternate_and_stay_on_the_page(
    columns: int, rows: int, page: str
) -> None:
    pdf, square_mm = board_pdf(BoardPattern(columns, rows), page)
    found = squares(pdf)
    assert len(found) == ((columns + 1) * (rows + 1) + 1) // 2
    np.testing.assert_allclose(found[:, 2:], square_mm, atol=1e-4)
    wide, high = page_mm(pdf)
    assert {round(wide, 1), round(high, 1)} == {round(side, 1) for side in PAGES[page]}
    assert found[:, 0].min() > 8 + 0.4 * square_mm
    assert found[:, 0].max() + square_mm < wide - 8 - 0.4 * square_mm
    assert found[:, 1].min() > 8 + 20
    step = np.rint((found[:, :2] - found[:, :2].min(0)) / square_mm)
    np.testing.assert_allclose(step * square_mm, found[:, :2] - found[:, :2].min(0), atol=1e-3)
    assert np.ptp(step[:, 0]) == columns
    assert np.ptp(step[:, 1]) == rows
    assert len({tuple(place) for place in step}) == len(step)
    assert len({int(place.sum()) % 2 for place in step}) == 1


def test_the_ruler_is_100_mm_and_the_words_say_what_to_measure() -> None:
    pdf, square_mm = board_pdf(BoardPattern(8, 6, 0.018))
    assert square_mm == pytest.approx(18)
    ends = re.findall(rb"([\d.]+) ([\d.]+) m ([\d.]+) \2 l S", pdf)
    assert [(float(b) - float(a)) * POINT_MM for a, _, b in ends] == [pytest.approx(100, abs=1e-3)]
    words = b" ".join(re.findall(rb"\((.*)\) Tj", pdf))
    assert b"--pattern 8x6" in words
    assert b"measure 8 squares" in words
    assert b"--square 0.018" in words
    assert b"Print at 100 %" in words


def test_the_file_is_a_pdf_whose_table_points_at_its_objects(tmp_path: Path) -> None:
    target = tmp_path / "board.pdf"
    assert write_board_pdf(target, BoardPattern(9, 6), page="A3") == pytest.approx(0.032)
    pdf = target.read_bytes()
    assert pdf.startswith(b"%PDF-1.4\n")
    assert pdf.endswith(b"%%EOF\n")
    table = int(re.findall(rb"startxref\n(\d+)\n", pdf)[0])
    assert pdf[table : table + 4] == b"xref"
    offsets = [int(found) for found in re.findall(rb"(\d{10}) 00000 n ", pdf)]
    for number, offset in enumerate(offsets, 1):
        assert pdf[offset:].startswith(b"%d 0 obj" % number)
    stream = re.search(rb"/Length (\d+) >>\nstream\n(.*)\nendstream", pdf, re.DOTALL)
    assert stream is not None
    assert len(stream[2]) == int(stream[1])


def test_what_cannot_be_printed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"--square 0\.05.*do not fit on A4"):
        board_pdf(BoardPattern(8, 6, 0.05))
    with pytest.raises(CalibrationError, match="unknown size 'a9'; use one of a4"):
        board_pdf(BoardPattern(8, 6), "a9")
    with pytest.raises(CalibrationError, match="3 to 59 inner corners"):
        board_pdf(BoardPattern(80, 6))
    with pytest.raises(BikepedError, match="cannot be written"):
        write_board_pdf(tmp_path / "none" / "board.pdf", BoardPattern(8, 6))

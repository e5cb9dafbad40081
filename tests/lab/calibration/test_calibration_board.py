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
from bikeped.lab.calibration.capture import board_pdf
from bikeped.lab.calibration.capture.board_pdf import (
    BOARDS,
    PAGES,
    draw_board,
    square_size_mm,
    write_board_pdf,
)
from bikeped.types import FloatArray

POINT_MM = 25.4 / 72
NUMBER = rb"(-?[\d.]+)"
LINE = NUMBER + rb" " + NUMBER + rb" [ml]\s+"
FINISHED = sorted(path.name for path in BOARDS.glob("*.pdf"))


def squares(pdf: bytes) -> FloatArray:
    """[n, 4] x, y, width, height in millimetres of the filled rectangles."""
    found = np.array(re.findall(LINE * 4 + rb"h", pdf), dtype=np.float64).reshape(-1, 4, 2)
    low, high = found.min(1), found.max(1)
    for corner, (x, y) in enumerate(((low, low), (high, low), (high, high), (low, high))):
        np.testing.assert_array_equal(found[:, corner], np.stack([x[:, 0], y[:, 1]], axis=1))
    return np.concatenate([low, high - low], axis=1) * POINT_MM


def page_mm(pdf: bytes) -> tuple[float, float]:
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert box is not None
    return float(box[1]) * POINT_MM, float(box[2]) * POINT_MM


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 14), st.integers(3, 14), st.sampled_from(sorted(PAGES)))
def test_squares_are_exact_alternate_and_stay_on_the_page(
    columns: int, rows: int, page: str
) -> None:
    pattern = BoardPattern(columns, rows)
    pdf, square_mm = draw_board(pattern, page), square_size_mm(pattern, page)
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
    assert [0, rows] in step.tolist()  # the top left square is black


def test_the_ruler_is_100_mm_and_the_words_say_what_to_measure() -> None:
    pattern = BoardPattern(8, 6, 0.018)
    assert square_size_mm(pattern) == pytest.approx(18)
    pdf = draw_board(pattern)
    lines = np.array(re.findall(LINE * 2, pdf), dtype=np.float64) * POINT_MM
    flat = lines[(lines[:, 1] == lines[:, 3]) & (lines[:, 2] - lines[:, 0] > 50)]
    assert (flat[:, 2] - flat[:, 0]).tolist() == [pytest.approx(100, abs=1e-3)]
    ticks = np.sort(lines[(lines[:, 0] == lines[:, 2])][:, 0])
    np.testing.assert_allclose(ticks, flat[0, 0] + np.arange(101), atol=1e-3)
    words = b" ".join(re.findall(rb"\((.*)\)\s+Tj", pdf))
    assert b"--pattern 8x6" in words
    assert b"measure 8 squares" in words
    assert b"--square 0.018" in words
    assert b"Print at 100 %" in words


def test_the_file_is_a_pdf_whose_table_points_at_its_objects(tmp_path: Path) -> None:
    target = tmp_path / "board.pdf"
    assert write_board_pdf(target, BoardPattern(10, 6), page="A3") == pytest.approx(0.032)
    pdf = target.read_bytes()
    assert pdf.startswith(b"%PDF-1.4\n")
    assert pdf.endswith(b"%%EOF\n")
    table = int(re.findall(rb"startxref\n(\d+)\n", pdf)[0])
    assert pdf[table : table + 4] == b"xref"
    offsets = [int(found) for found in re.findall(rb"(\d{10}) 00000 n ", pdf)]
    for number, offset in enumerate(offsets, 1):
        assert pdf[offset:].startswith(b"%d 0 obj" % number)
    root = pdf[offsets[int(re.findall(rb"/Root (\d+) 0 R", pdf)[0]) - 1] :]
    assert b"/PrintScaling /None" in root[: root.index(b"endobj")]
    stream = re.search(rb"/Length (\d+) 0 R >>\nstream\n(.*?)\nendstream", pdf, re.DOTALL)
    assert stream is not None
    length = re.match(rb"\d+ 0 obj\n(\d+)\n", pdf[offsets[int(stream[1]) - 1] :])
    assert length is not None
    assert len(stream[2]) in (int(length[1]), int(length[1]) - 1)
    assert b" obj\n" not in stream[2]


@pytest.mark.parametrize("name", FINISHED)
def test_a_finished_board_is_what_is_drawn_today(name: str) -> None:
    """Draw it anew with `draw_board` and review the difference when this fails."""
    size, page = name.removesuffix(".pdf").split("-")
    columns, rows = map(int, size.split("x"))
    assert (BOARDS / name).read_bytes() == draw_board(BoardPattern(columns, rows), page)


def test_usual_boards_need_no_matplotlib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {f"{size}-{page}.pdf" for size in ("8x6", "9x6") for page in PAGES} <= set(FINISHED)

    def absent(*packages: str, extra: str | None = None) -> None:
        raise BikepedError(f"{packages[0]} is not installed; pip install 'bikeped[{extra}]'")

    monkeypatch.setattr(board_pdf, "require", absent)
    target = tmp_path / "board.pdf"
    for square_m in (1.0, 0.021):  # not given, and the one that is drawn anyway
        assert write_board_pdf(target, BoardPattern(8, 6, square_m)) == pytest.approx(0.021)
        assert target.read_bytes() == (BOARDS / "8x6-a4.pdf").read_bytes()
        target.unlink()
    for other in (BoardPattern(8, 6, 0.02), BoardPattern(14, 6)):
        with pytest.raises(BikepedError, match=r"pip install 'bikeped\[calibrate\]'"):
            write_board_pdf(target, other)
    assert not target.exists()


def test_what_cannot_be_printed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"--square 0\.05.*do not fit on A4"):
        draw_board(BoardPattern(8, 6, 0.05))
    with pytest.raises(CalibrationError, match="unknown size 'a9'; use one of a4"):
        draw_board(BoardPattern(8, 6), "a9")
    with pytest.raises(CalibrationError, match="3 to 59 inner corners"):
        draw_board(BoardPattern(80, 6))
    with pytest.raises(BikepedError, match="cannot be written"):
        write_board_pdf(tmp_path / "none" / "board.pdf", BoardPattern(8, 6))

"""A checkerboard to print: a PDF page of vectors, with a ruler to hold a real one against.

Written by hand: the page holds rectangles, lines and a few words in a font that every viewer has,
and the squares keep their size to a thousandth of a millimetre.
"""

from __future__ import annotations

from pathlib import Path

from bikeped.errors import CalibrationError
from bikeped.files import write_whole
from bikeped.lab.calibration.board_view import BoardPattern

#: Page sizes in millimetres, upright.
PAGES = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
_POINT_MM = 72 / 25.4
_EDGE_MM = 8.0  # what printers leave blank
_WORDS_MM = 24.0  # for the words and the ruler below the board
_RULER_MM = 100


def write_board_pdf(path: Path, pattern: BoardPattern, *, page: str = "a4") -> float:
    """Writes the page and returns the side of its squares in metres, as drawn.

    CalibrationError as `board_pdf`; BikepedError when the file cannot be written.
    """
    content, square_mm = board_pdf(pattern, page)
    write_whole(path, content)
    return square_mm / 1000


def board_pdf(pattern: BoardPattern, page: str = "a4") -> tuple[bytes, float]:
    """The PDF's bytes, and the side of its squares in millimetres.

    A square of 1 m, `BoardPattern`'s way of saying that none was given, stands for the largest
    whole millimetre that fits. The page lies on its side where that suits the board.
    CalibrationError for an unknown page and for squares that do not fit it.
    """
    size = PAGES.get(page.lower())
    if size is None:
        raise CalibrationError(f"page: unknown size {page!r}; use one of {', '.join(PAGES)}")
    columns, rows = pattern.columns + 1, pattern.rows + 1
    if min(pattern.columns, pattern.rows) < 3 or max(columns, rows) > 60:
        raise CalibrationError(
            f"--pattern {pattern.columns}x{pattern.rows}: a board has 3 to 59 inner corners a side"
        )
    ways = [size, size[::-1]]
    most = [_largest_mm(columns, rows, way) for way in ways]
    wide, high = ways[0] if most[0] >= most[1] else ways[1]
    largest = max(most)
    square = int(largest) if pattern.square_m == 1.0 else pattern.square_m * 1000
    if not 2 <= square <= largest:
        raise CalibrationError(
            f"--square {square / 1000:g}: {columns} x {rows} squares of {square:g} mm do not fit "
            f"on {page.upper()}, which takes 2 to {largest:.1f} mm; without --square it takes the "
            "largest"
        )
    marks = _board(columns, rows, square, wide, high) + _ruler(high)
    marks += _words(pattern, square, page, high)
    return _document("\n".join(marks).encode("latin-1"), wide, high), float(square)


def _largest_mm(columns: int, rows: int, page: tuple[float, float]) -> float:
    return min(
        # Half a square of white round the outer ones: without it they cannot be told apart.
        (page[0] - 2 * _EDGE_MM) / (columns + 1),
        (page[1] - 2 * _EDGE_MM - _WORDS_MM) / (rows + 1),
    )


def _board(columns: int, rows: int, square: float, wide: float, high: float) -> list[str]:
    left = (wide - columns * square) / 2
    top = _EDGE_MM + (high - 2 * _EDGE_MM - _WORDS_MM - rows * square) / 2
    marks = ["0 g"]
    for row in range(rows):
        for column in range(row % 2, columns, 2):
            # One rectangle a square: neighbours touch at their corners and nowhere else.
            x, y = left + column * square, high - top - (row + 1) * square
            marks.append(f"{_pt(x)} {_pt(y)} {_pt(square)} {_pt(square)} re")
    return [*marks, "f"]


def _ruler(high: float) -> list[str]:
    """100 mm with a tick every millimetre, longer every five and ten; y counts from below."""
    base, left = _EDGE_MM + 13, _EDGE_MM + 2
    marks = [f"0 G {_pt(0.15)} w"]
    for tick in range(_RULER_MM + 1):
        length = 4.0 if tick % 10 == 0 else 3.0 if tick % 5 == 0 else 2.0
        x = left + tick
        marks.append(f"{_pt(x)} {_pt(base)} m {_pt(x)} {_pt(base + length)} l")
    marks.append(f"{_pt(left)} {_pt(base)} m {_pt(left + _RULER_MM)} {_pt(base)} l S")
    marks += [
        _text(left + tick - 0.65 * len(str(tick)), base + 4.6, 7, str(tick))
        for tick in range(0, _RULER_MM + 1, 10)
    ]
    marks.append(_text(left + _RULER_MM + 4, base + 0.5, 8, "mm: 100 on a real ruler, or the"))
    marks.append(_text(left + _RULER_MM + 4, base - 3.0, 8, "printer has changed the size."))
    return marks


def _words(pattern: BoardPattern, square: float, page: str, high: float) -> list[str]:
    count = max(pattern.columns, pattern.rows)
    what = (
        f"bikeped calibration board, --pattern {pattern.columns}x{pattern.rows}, squares of "
        f"{square:g} mm as drawn, {page.upper()}. Print at 100 %, not fitted to the page; glue it "
        "flat onto a stiff plate."
    )
    measure = (
        f"Then measure {count} squares in a row with a ruler, divide by {count}, and pass the side "
        f"of one in metres: --square {square / 1000:g} if it is exactly as drawn."
    )
    return [
        _text(_EDGE_MM + 2, _EDGE_MM + 5.5 - 4.0 * number, 7.5, line)
        for number, line in enumerate((what, measure))
    ]


def _text(x_mm: float, y_mm: float, size_pt: float, words: str) -> str:
    safe = words.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    return f"BT /F1 {size_pt:g} Tf {_pt(x_mm)} {_pt(y_mm)} Td ({safe}) Tj ET"


def _pt(mm: float) -> str:
    return f"{mm * _POINT_MM:.4f}"


def _document(content: bytes, wide: float, high: float) -> bytes:
    """A PDF 1.4 file of one page: catalogue, pages, page, font, content, and where each begins."""
    box = f"[0 0 {_pt(wide)} {_pt(high)}]"
    # Viewers that honour it print at 100 % on their own.
    parts = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 5 0 R "
        "/Resources << /Font << /F1 4 0 R >> >> >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
    ]
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    begins = []
    for number, part in enumerate(parts, 1):
        begins.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, part)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(parts) + 1)
    for begin in begins:
        out += b"%010d 00000 n \n" % begin
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (
        len(parts) + 1,
        table,
    )
    return bytes(out)

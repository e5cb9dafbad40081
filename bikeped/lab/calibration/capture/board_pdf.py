"""A checkerboard to print: a PDF page of vectors, with a ruler to compare with a real one.

Boards of the usual sizes are files in `boards/`, drawn by `draw_board`, so that they can be printed
without matplotlib.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.errors import CalibrationError, require
from bikeped.files import write_whole
from bikeped.lab.calibration.board_view import BoardPattern

#: Page sizes in millimetres, upright.
PAGES = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
#: Finished boards, `COLUMNSxROWS-PAGE.pdf`, with the largest squares of whole millimetres.
BOARDS = Path(__file__).with_name("boards")
_POINT_PER_MM = 72 / 25.4
_EDGE_MM = 8.0  # printers leave it blank
_TEXT_MM = 24.0  # for the text and the ruler below the board
_RULER_MM = 100


def write_board_pdf(path: Path, pattern: BoardPattern, *, page: str = "a4") -> float:
    """Writes the page and returns the side of its squares in metres, as drawn.

    Raises CalibrationError as `square_size_mm`, BikepedError when the file cannot be written, and
    MissingPackageError without matplotlib for a board that is not in `BOARDS`.
    """
    square_mm = square_size_mm(pattern, page)
    finished = BOARDS / f"{pattern}-{page.lower()}.pdf"
    if finished.exists() and square_mm == square_size_mm(_largest(pattern), page):
        write_whole(path, finished.read_bytes())
    else:
        require("matplotlib", extra="calibrate")
        write_whole(path, draw_board(pattern, page))
    return square_mm / 1000


def square_size_mm(pattern: BoardPattern, page: str = "a4") -> float:
    """The side of the squares in millimetres.

    A square of 1 m, `BoardPattern`'s default, stands for the largest whole millimetre that fits.
    CalibrationError for an unknown page and for squares that do not fit it.
    """
    if page.lower() not in PAGES:
        raise CalibrationError(f"page: unknown size {page!r}; use one of {', '.join(PAGES)}")
    if not 3 <= min(pattern.columns, pattern.rows) <= max(pattern.columns, pattern.rows) < 60:
        raise CalibrationError(f"--pattern {pattern}: a board has 3 to 59 inner corners a side")
    largest = max(_largest_mm(pattern, way) for way in _ways(page))
    square = float(int(largest)) if pattern == _largest(pattern) else pattern.square_m * 1000
    if not 2 <= square <= largest:
        raise CalibrationError(
            f"--square {square / 1000:g}: {pattern.columns + 1} x {pattern.rows + 1} squares of "
            f"{square:g} mm do not fit on {page.upper()}, which takes 2 to {largest:.1f} mm; "
            "without --square it takes the largest"
        )
    return square


def draw_board(pattern: BoardPattern, page: str = "a4") -> bytes:
    """The PDF of one page, upright or on its side as suits the board; the same bytes each time."""
    import matplotlib as mpl
    from matplotlib.backends import backend_pdf
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    square = square_size_mm(pattern, page)
    wide, high = max(_ways(page), key=lambda way: _largest_mm(pattern, way))
    inches = (wide / 25.4, high / 25.4)
    left = (wide - (pattern.columns + 1) * square) / 2
    bottom = _EDGE_MM + _TEXT_MM + (high - 2 * _EDGE_MM - _TEXT_MM) / 2
    bottom -= (pattern.rows + 1) * square / 2
    out = io.BytesIO()
    # Core fonts need no embedding, and uncompressed streams do not depend on zlib's version.
    settings: dict[str, Any] = {
        **mpl.rcParamsDefault,
        "pdf.use14corefonts": True,
        "pdf.compression": 0,
        "font.family": "Helvetica",
    }
    with mpl.rc_context(settings):
        figure = Figure(figsize=inches, dpi=72)
        figure.patch.set_visible(False)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, wide), ylim=(0, high))
        axes.set_axis_off()
        # One outline a square: neighbours touch at their corners and nowhere else.
        corners = square * np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
        squares = [
            Outline(corners + np.array([x, y]), closed=True)
            for row in range(pattern.rows + 1)
            for column in range((pattern.rows - row) % 2, pattern.columns + 1, 2)
            for x, y in [(left + column * square, bottom + row * square)]
        ]
        board = Outline.make_compound_path(*squares)
        axes.add_patch(PathPatch(board, facecolor="black", linewidth=0))
        base, start = _EDGE_MM + 13, _EDGE_MM + 2
        lines = [Outline([(start, base), (start + _RULER_MM, base)])]
        for tick in range(_RULER_MM + 1):
            length = 4.0 if tick % 10 == 0 else 3.0 if tick % 5 == 0 else 2.0
            lines.append(Outline([(start + tick, base), (start + tick, base + length)]))
        ruler = Outline.make_compound_path(*lines)
        axes.add_patch(PathPatch(ruler, fill=False, linewidth=0.15 * _POINT_PER_MM))
        for x, y, size, text in _texts(pattern, square, page, start, base):
            axes.text(x, y, text, fontsize=size)
        undated = dict.fromkeys(("CreationDate", "Creator", "Producer"))
        pdf: Any = backend_pdf  # its parts are not typed
        file = pdf.PdfFile(out, metadata=undated)
        file.newPage(*inches)
        figure.draw(pdf.RendererPdf(file, 72, inches[1], inches[0]))
        file.endStream()
        # Viewers that honour it print at 100 % without being asked.
        file.writeObject(
            file.rootObject,
            {
                "Type": pdf.Name("Catalog"),
                "Pages": file.pagesObject,
                "ViewerPreferences": {"PrintScaling": pdf.Name("None")},
            },
        )
        file.finalize()
        file.close()
    return out.getvalue()


def _largest(pattern: BoardPattern) -> BoardPattern:
    return BoardPattern(pattern.columns, pattern.rows)


def _ways(page: str) -> tuple[tuple[float, float], tuple[float, float]]:
    size = PAGES[page.lower()]
    return size, (size[1], size[0])


def _largest_mm(pattern: BoardPattern, page: tuple[float, float]) -> float:
    # Half a square of white around the outer ones: without it they cannot be told apart.
    return min(
        (page[0] - 2 * _EDGE_MM) / (pattern.columns + 2),
        (page[1] - 2 * _EDGE_MM - _TEXT_MM) / (pattern.rows + 2),
    )


def _texts(
    pattern: BoardPattern, square: float, page: str, start: float, base: float
) -> list[tuple[float, float, float, str]]:
    """Position in mm, size in points, and text: the ruler's numbers, and what to measure."""
    count = max(pattern.columns, pattern.rows)
    what = (
        f"bikeped calibration board, --pattern {pattern}, squares of {square:g} mm as drawn, "
        f"{page.upper()}. Print at 100 %, not fitted to the page; glue it flat onto a stiff plate."
    )
    measure = (
        f"Then measure {count} squares in a row with a ruler, divide by {count}, and pass the side "
        f"of one in metres: --square {square / 1000:g} if it is exactly as drawn."
    )
    ticks = range(0, _RULER_MM + 1, 10)
    return [
        *((start + tick - 0.65 * len(str(tick)), base + 4.6, 7.0, str(tick)) for tick in ticks),
        (start + _RULER_MM + 4, base + 0.5, 8.0, "mm: 100 on a real ruler, or the"),
        (start + _RULER_MM + 4, base - 3.0, 8.0, "printer has changed the size."),
        (start, _EDGE_MM + 5.5, 7.5, what),
        (start, _EDGE_MM + 1.5, 7.5, measure),
    ]

"""What all figures share: sheets with title and caption, colours, labels, bars, saving.

Colours are Okabe and Ito's, distinct under every common colour blindness; each series also has a
marker, dash or hatch of its own, so that a grey print reads the same.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from bikeped.errors import require
from bikeped.files import write_whole
from bikeped.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLACK, DARK, GREY, LIGHT = "#1a1a1a", "#3d3d3d", "#6b6b6b", "#d9d9d9"
BLUE, SKY, GREEN = "#0072b2", "#56b4e9", "#009e73"
ORANGE, RED, PURPLE = "#e69f00", "#d55e00", "#cc79a7"
#: A line's dash as matplotlib takes it: a name, or an offset with lengths on and off.
Dash: TypeAlias = "str | tuple[int, tuple[int, ...]]"
#: How a series is drawn: colour, marker, dash.
SeriesStyle: TypeAlias = "tuple[str, str, Dash]"
#: The styles of a figure's series, in order.
SERIES: tuple[SeriesStyle, ...] = (
    (BLUE, "o", "-"),
    (RED, "s", "--"),
    (GREEN, "^", "-."),
    (PURPLE, "D", ":"),
    (ORANGE, "v", (0, (5, 1, 1, 1, 1, 1))),
    (SKY, "P", (0, (1, 1))),
    (BLACK, "X", (0, (8, 2))),
)
_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": BLACK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.0,
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.color": BLACK,
    "ytick.color": BLACK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "pdf.fonttype": 42,
    "svg.hashsalt": "bikeped",
}
DPI = 160
_TITLE_PT, _CAPTION_PT, _MARGIN_IN = 11.5, 8.5, 0.12


class FigureSheet:
    """One figure: title on top, panels, caption below. Use as a context manager around drawing.

    `width` and `height` in inches are those of the panels with their labels; title and caption
    come on top of them, and `legend_rows` lines of a legend between panels and caption.
    """

    def __init__(
        self,
        title: str,
        caption: str,
        width: float = 7.0,
        height: float = 3.8,
        rows: int = 1,
        columns: int = 1,
        legend_rows: int = 0,
        **subplots: Any,
    ) -> None:
        require("matplotlib")
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._context = mpl.rc_context({**mpl.rcParamsDefault, **_SETTINGS})
        self._context.__enter__()
        height = max(height, 2.0)  # below, labels leave no room for the panels
        title_lines = textwrap.wrap(title, int(width * 11.2)) or [""]
        lines = textwrap.wrap(caption, int(width * 15.6))
        above = len(title_lines) * _TITLE_PT * 1.3 / 72 + _MARGIN_IN
        below = len(lines) * _CAPTION_PT * 1.4 / 72 + 2 * _MARGIN_IN
        self._legend_at = below
        below += legend_rows * 0.2 + (0.06 if legend_rows else 0.0)
        total = height + above + below
        self._legend_at /= total
        self.figure: Figure = Figure(figsize=(width, total), dpi=DPI)
        FigureCanvasAgg(self.figure)
        self.figure.set_layout_engine(
            "constrained",
            rect=(0.008, below / total, 0.984, height / total),
            w_pad=0.06,
            h_pad=0.05,
        )
        left, margin = _MARGIN_IN / width, _MARGIN_IN / total
        bold = {"fontsize": _TITLE_PT, "fontweight": "bold", "va": "top", "color": BLACK}
        small = {"fontsize": _CAPTION_PT, "va": "bottom", "color": DARK, "linespacing": 1.3}
        # A dollar sign in the name of a scenario is not mathematics.
        self.figure.text(left, 1 - margin, escape_dollars("\n".join(title_lines)), bold)
        self.figure.text(left, margin, escape_dollars("\n".join(lines)), small)
        grid = self.figure.subplots(rows, columns, squeeze=False, **subplots)
        self.axes: list[Axes] = list(grid.ravel())

    def __enter__(self) -> FigureSheet:
        return self

    def __exit__(self, *problem: object) -> None:
        self._context.__exit__(None, None, None)

    def legend(self, handles: Sequence[Any] | None = None, columns: int = 4) -> None:
        """One legend for all panels in the lines kept free for it (`legend_rows`)."""
        if handles is None:
            handles, labels = self.axes[0].get_legend_handles_labels()
        else:
            labels = [str(h.get_label()) for h in handles]
        found = self.figure.legend(
            handles,
            labels,
            loc="lower center",
            bbox_to_anchor=(0.5, self._legend_at),
            borderaxespad=0.0,
            borderpad=0.1,
            ncols=min(columns, max(len(labels), 1)),
            handlelength=2.6,
        )
        found.set_in_layout(False)

    def label_rows(self, labels: Sequence[str], top: float = -0.5) -> None:
        """Names the rows 0, 1, ... of horizontal bars or points, the first on top."""
        self.axes[0].set_yticks(range(len(labels)), [escape_dollars(text) for text in labels])
        self.axes[0].set_ylim(len(labels) - 1 - top, top)
        for axes in self.axes:
            axes.grid(visible=False, axis="y")
            axes.tick_params(axis="y", length=0)

    def colour_bar(self, image: Any, label: str, extend: str, **place: Any) -> None:
        """A bar beside all panels that explains an image's colours."""
        bar = self.figure.colorbar(image, ax=self.axes, label=label, extend=extend, **place)
        bar.outline.set_visible(False)  # type: ignore[operator]

    def save(self, folder: Path, stem: str) -> list[Path]:
        """PNG and PDF of the sheet; the same drawing gives the same bytes, for dates are left out.

        BikepedError names a file that cannot be written.
        """
        paths = []
        for kind, metadata in (
            ("png", {"Software": None}),
            ("pdf", {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": None}),
        ):
            data = io.BytesIO()
            self.figure.savefig(data, format=kind, metadata=metadata)
            path = folder / f"{stem}.{kind}"
            write_whole(path, data.getvalue())
            paths.append(path)
        return paths


def label(
    axes: Axes, text: str, at: tuple[Any, Any], offset: tuple[float, float] = (0, 0), **style: Any
) -> None:
    """Small text at `at`, moved by `offset` in points."""
    style = {"fontsize": 8, **style}
    axes.annotate(text, at, offset, textcoords="offset points", **style)


def plot_series(axes: Axes, x: Any, y: Any, style: SeriesStyle, **more: Any) -> None:
    """A line with markers in one of the styles of `SERIES`."""
    colour, marker, dash = style
    axes.plot(x, y, color=colour, marker=marker, linestyle=dash, **more)


def fill(colour: str, hatch: str = "") -> dict[str, Any]:
    """Keywords of a bar or patch without edges."""
    return {"facecolor": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0}


def means_and_arms(summaries: Iterable[Mapping[str, Any]]) -> tuple[FloatArray, FloatArray]:
    """Means [n] in per cent, and the interval's arms [2, n]: 0 where there is no interval."""
    rows = list(summaries)
    mean, low, high = (to_percents(row.get(key) for row in rows) for key in ("mean", "low", "high"))
    return mean, np.nan_to_num(np.maximum(np.stack([mean - low, high - mean]), 0.0))


def escape_dollars(text: str) -> str:
    """Text as it is: matplotlib takes what stands between two dollar signs for mathematics."""
    return text.replace("$", r"\$")


def to_floats(values: Iterable[float | None], scale: float = 1.0) -> FloatArray:
    """Figures from JSON as an array; null is NaN, which leaves a gap."""
    return np.asarray([math.nan if v is None else scale * v for v in values], dtype=np.float64)


def to_percents(values: Iterable[float | None]) -> FloatArray:
    """Shares from JSON in per cent."""
    return to_floats(values, 100.0)


def file_stem(name: str) -> str:
    """A file name from a scenario's name, which may hold anything."""
    words = "".join(c.lower() if c.isascii() and c.isalnum() else " " for c in name).split()
    return "-".join(words)[:60] or "scenario"

"""Draws docs/architecture.svg: rooms by layer, and the imports between them, read from the code.

`reference_pages.py` writes it.
Layers come from the import-linter contracts in pyproject.toml, arrows from the import graph,
sentences from the rooms' docstrings.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import NamedTuple

import grimp
import jinja2
from importlinter import configuration
from importlinter.application.use_cases import read_user_options

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "architecture.svg"
_WIDTH, _ROW, _BOX, _MARGIN = 1240, 88, 56, 16
#: Imported by nearly every room: their arrows would hide the others.
_COMMON = {"types", "errors", "files", "faults", "cores", "templates"}

_TEMPLATE = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {{ width }} {{ height }}" \
font-family="system-ui, sans-serif">
<title>Rooms of bikeped: who imports whom</title>
<style>.floor{fill:#f6f8fa;stroke:#d0d7de}.room{fill:#fff;stroke:#57606a}.name{font-size:14px;\
font-weight:600;fill:#1f2328}.job{font-size:10.5px;fill:#424a53}.import{fill:none;stroke:#8c959f;\
stroke-width:.8;opacity:.55}.title{font-size:13px;fill:#57606a}</style>
<rect width="{{ width }}" height="{{ height }}" fill="#fff"/>
{% for floor in floors -%}
<rect class="floor" x="6" y="{{ floor.y }}" width="{{ width - 12 }}" height="{{ floor.height }}" \
rx="8"/>
<text class="title" x="18" y="{{ floor.y + 18 }}">{{ floor.title }}</text>
{% endfor -%}
{% for a, b in arrows -%}
<path class="import" d="M{{ a.x + a.width // 2 }} {{ a.y + box }}C{{ a.x + a.width // 2 }} \
{{ a.y + box + 40 }} {{ b.x + b.width // 2 }} {{ b.y - 40 }} {{ b.x + b.width // 2 }} {{ b.y }}"/>
{% endfor -%}
{% for room in rooms -%}
<rect class="room" x="{{ room.x }}" y="{{ room.y }}" width="{{ room.width }}" height="{{ box }}" \
rx="5"/>
<text class="name" x="{{ room.x + 8 }}" y="{{ room.y + 18 }}">{{ room.name }}</text>
{% for line in room.lines -%}
<text class="job" x="{{ room.x + 8 }}" y="{{ room.y + 33 + 12 * loop.index0 }}">{{ line }}</text>
{% endfor -%}
{% endfor -%}
</svg>
"""


class _Room(NamedTuple):
    module: str
    name: str
    lines: list[str]  #: what it is for
    x: int
    y: int
    width: int


class _Floor(NamedTuple):
    title: str
    y: int
    height: int


def _sentence(module: str) -> str:
    """The first sentence of a room's docstring."""
    path = ROOT / module.replace(".", "/")
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
    return re.split(r"(?<=\.)\s|\n\n", " ".join(text.split("\n\n")[0].split()))[0].rstrip(".")


def _wrapped(text: str, width_px: int) -> list[str]:
    """At most two lines of small type; the rest is cut at a word."""
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) > width_px // 5.9:
            if len(lines) == 2:
                lines[-1] += " ..."
                break
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def draw() -> str:
    """The picture as SVG text."""
    configuration.configure()
    options = read_user_options(config_filename=str(ROOT / "pyproject.toml"))
    layered = {
        contract["containers"][0]: contract["layers"]
        for contract in options.contracts_options
        if contract["type"] == "layers"
    }
    rooms: list[_Room] = []
    floors: list[_Floor] = []
    y = _MARGIN
    for container in ("bikeped.lab", "bikeped"):
        top = y
        y += 28
        for layer in layered[container]:
            names = [name.strip(" ()") for name in re.split(r"[|:]", layer)]
            if "lab" in names:
                continue
            width = min((_WIDTH - 2 * _MARGIN - 12 * (len(names) - 1)) // len(names), 380)
            left = (_WIDTH - len(names) * (width + 12) + 12) // 2
            for i, name in enumerate(names):
                lines = _wrapped(_sentence(f"{container}.{name}"), width)
                x = left + i * (width + 12)
                rooms.append(_Room(f"{container}.{name}", name, lines, x, y, width))
            y += _ROW
        title = (
            "The lab, at a desk. It may import the device; the device never imports it."
            if container == "bikeped.lab"
            else "The device, on the pole. A room imports rooms below it, never above."
        )
        floors.append(_Floor(title, top, y - top - 20))
    graph = grimp.build_graph("bikeped")
    arrows = [
        (a, b)
        for a in rooms
        for b in rooms
        if a.module.rpartition(".")[0] == b.module.rpartition(".")[0]
        and b.name not in _COMMON
        and a is not b
        and graph.direct_import_exists(importer=a.module, imported=b.module, as_packages=True)
    ]
    environment = jinja2.Environment(autoescape=True, trim_blocks=False)
    return environment.from_string(_TEMPLATE).render(
        width=_WIDTH, height=y, box=_BOX, floors=floors, rooms=rooms, arrows=arrows
    )

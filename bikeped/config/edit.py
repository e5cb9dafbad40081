"""Changing values in the text of a configuration file; comments, order and quotes stay.

Only the characters of the values are replaced, at the places that PyYAML's nodes name. The result
is read again and must hold exactly what was asked for.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from bikeped.config.strict_yaml import load_sections, load_yaml
from bikeped.errors import ConfigError


def set_values(text: str, values: Mapping[str, Mapping[str, Any]], source: str) -> str:
    """`text` with keys set, as {section: {key: value}}; a missing key goes to its section's end.

    Everything else stays as it is, and so does the column of a comment behind a changed value where
    the value leaves room. Raises ConfigError, naming `source` and the section, when that is not
    possible.
    """
    for section, new in values.items():
        data = load_sections(text, source)
        old = data.get(section)
        if section not in data:
            text = replace_section(text, section, new, source)
        elif isinstance(old, dict) and old:
            after = _set_keys(text, section, new)
            text = _checked(after, {**data, section: {**old, **new}}, section, source)
        else:
            raise ConfigError(
                f"{source}: {section}: is empty; write its keys one below the other, or remove it"
            )
    return text


def replace_section(
    text: str, section: str, values: Mapping[str, Any], source: str, note: str = ""
) -> str:
    """`text` with a whole section replaced, its comments too, or added at the end.

    `note` becomes a comment behind the section's name. Comments before and behind the section stay.
    Raises ConfigError as `set_values` does.
    """
    data = load_sections(text, source)
    start, end, indent = _span(text, section)
    newline, before, old = _newline(text), text[:start], text[start:end]
    block = newline.join(indent + line for line in section_lines(section, values, note))
    if not old and before.removeprefix("\ufeff") and not before.endswith("\n"):
        block = newline + block
    if not old or old.endswith("\n"):
        block += newline
    return _checked(before + block + text[end:], {**data, section: dict(values)}, section, source)


def section_lines(section: str, values: Mapping[str, Any], note: str = "") -> list[str]:
    """The lines of a section, without line ends."""
    head = f"{section}:  # {note}" if note else f"{section}:"
    return [head, *(f"  {key}: {_written(value)}" for key, value in values.items())]


def _checked(after: str, expected: dict[str, Any], section: str, source: str) -> str:
    """`after`, if it holds what is expected."""
    with contextlib.suppress(ValueError):
        if load_yaml(after) == expected:
            return after
    raise ConfigError(
        f"{source}: its {section} section cannot be changed without changing the rest, so nothing "
        f"was written; give {section}: lines of its own, one key a line"
    )


def _set_keys(text: str, section: str, values: Mapping[str, Any]) -> str:
    """See `set_values`, for a section that is there and has keys."""
    root: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    node = next(value for key, value in root.value if key.value == section)
    spans = {key.value: _extent(text, value) for key, value in node.value}
    _, end = _extent(text, node.value[-1][1])
    edits = [(*spans[key], value) for key, value in values.items() if key in spans]
    added = [f"{key}: {_written(value)}" for key, value in values.items() if key not in spans]
    if node.flow_style:
        text = text[:end] + "".join(f", {pair}" for pair in added) + text[end:]
    else:
        indent = " " * node.start_mark.column
        lines = "".join(f"{_newline(text)}{indent}{pair}" for pair in added)
        rest_of_line, *below = re.split(r"(\r?\n)", text[end:], maxsplit=1)
        text = text[:end] + rest_of_line + lines + "".join(below)
    for start, end, value in sorted(edits, key=lambda edit: -edit[0]):
        new = _written(value) if start < end else f" {_written(value)}"
        gap = re.compile(" +(?=#)").match(text, end)
        if gap and "\n" not in text[start:end]:
            end = gap.end()
            new += " " * max(1, end - start - len(new))
        text = text[:start] + new + text[end:]
    return text


def _extent(text: str, node: Any) -> tuple[int, int]:
    """First and one past the last character of a value, without comments behind it."""
    last = node
    while isinstance(last, yaml.CollectionNode) and last.value and not last.flow_style:
        last = last.value[-1][1] if isinstance(last, yaml.MappingNode) else last.value[-1]
    start = node.start_mark.index
    return start, start + len(text[start : last.end_mark.index].rstrip())


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"


def _span(text: str, section: str) -> tuple[int, int, str]:
    """First and one past the last character of a section's lines, and their indentation.

    Comments that are indented deeper than the section's name belong to it, others to what follows.
    A section that is not there begins and ends at the text's end.
    """
    root: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        return len(text), len(text), ""
    if root.flow_style:
        return 0, len(text), ""
    column = root.start_mark.column
    for key, value in root.value:
        if key.value == section:
            _, end = _extent(text, value)
            rest = re.compile(rf".*(\s*\n {{{column + 1},}}#.*)*\n?").match(text, end)
            return key.start_mark.index - column, rest.end() if rest else end, " " * column
    return len(text), len(text), " " * column


def _written(value: Any) -> str:
    """A value as YAML text; a float without an exponent, which YAML 1.1 would read as a word."""
    if isinstance(value, float):
        return np.format_float_positional(value, trim="0")
    with contextlib.suppress(ValueError):
        if isinstance(value, str) and load_yaml(value) == value:
            return value
    return json.dumps(value)

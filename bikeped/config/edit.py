"""Changing values in the text of a configuration file; comments, order and quotes stay.

Only the edited section passes through ruamel.yaml, as nodes with the text that was written
(`null`, `~`, `0x10`); everything around it is kept to the character. The result is read again and
must hold exactly what was asked for.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from bikeped.config.strict_yaml import load_sections, load_yaml
from bikeped.errors import ConfigError


def set_values(text: str, values: Mapping[str, Mapping[str, Any]], source: str) -> str:
    """`text` with keys set, as {section: {key: value}}; a missing key goes to its section's end.

    Lines of other keys stay as they are, and so does the column of a comment behind a changed
    value where the value leaves room. Only a value over several lines is set anew by ruamel.yaml.
    Raises ConfigError, naming `source` and the section, when that is not possible.
    """
    for section, new in values.items():
        data = load_sections(text, source)
        old = data.get(section)
        if section not in data:
            text = replace_section(text, section, new, source)
        elif isinstance(old, dict) and old:
            after = _set_keys(text, section, new, source)
            text = _checked(text, after, section, {**old, **new}, source)
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
    lines = section_lines(section, values, note)
    after = _splice(text, *_span(text, section, source), lines)
    return _checked(text, after, section, values, source)


def completed(text: str) -> str:
    """`text` with `complete: true` as its last line, if it is not there."""
    if "complete" in load_yaml(text):
        return text
    newline = "\r\n" if "\r\n" in text else "\n"
    return text + ("" if text.endswith("\n") else newline) + "complete: true" + newline


def section_lines(section: str, values: Mapping[str, Any], note: str = "") -> list[str]:
    """The lines of a section, without line ends."""
    head = f"{section}:  # {note}" if note else f"{section}:"
    return [head, *(f"  {key}: {_written(value)}" for key, value in values.items())]


def _checked(before: str, after: str, section: str, values: Mapping[str, Any], source: str) -> str:
    """`after`, if it holds these values in its section and else what `before` holds."""
    with contextlib.suppress(ValueError):
        if load_yaml(after) == {**load_sections(before, source), section: dict(values)}:
            return after
    raise ConfigError(
        f"{source}: its {section} section cannot be changed without changing the rest, so nothing "
        f"was written; give {section}: lines of its own, one key a line"
    )


def _yaml() -> YAML:
    yaml = YAML()
    yaml.width = 1_000_000  # never break a line
    return yaml


def _compose(text: str, source: str) -> Any:
    try:
        return _yaml().compose(text)
    except YAMLError as error:
        what = " ".join(str(error).split())
        raise ConfigError(f"{source}: cannot be edited ({what}); simplify it there") from error


def _set_keys(text: str, section: str, values: Mapping[str, Any], source: str) -> str:
    """See `set_values`, for a section that is there."""
    start, end, indent = _span(text, section, source)
    lines = text[start:end].replace("\r\n", "\n").split("\n")
    lines = [line.removeprefix(indent) for line in lines]
    root = _compose("\n".join(lines), source)
    node = next(value for key, value in root.value if key.value == section)
    found = {key.value: index for index, (key, _) in enumerate(node.value)}
    for name, value in values.items():
        new = _compose(_written(value), source)
        if name in found:
            key, old = node.value[found[name]]
            new.comment = old.comment
            node.value[found[name]] = (key, new)
        else:
            node.value.append((_compose(name, source), new))
    yaml, out = _yaml(), io.StringIO()
    yaml.map_indent = node.value[0][0].start_mark.column
    yaml.serialize(root, out)
    # ruamel sets `key:  value` with one space: lines that say the same stay as they were written.
    was = {" ".join(line.split()): line for line in lines}
    edited = [was.get(" ".join(line.split()), line) for line in out.getvalue().splitlines()]
    return _splice(text, start, end, indent, edited)


def _splice(text: str, start: int, end: int, indent: str, lines: list[str]) -> str:
    """`text` with these lines in place of start to end; they end as those did."""
    newline = "\r\n" if "\r\n" in text else "\n"
    before, old = text[:start], text[start:end]
    block = newline.join(indent + line if line else line for line in lines)
    if not old and before.removeprefix("\ufeff") and not before.endswith("\n"):
        block = newline + block
    if not old or old.endswith("\n"):
        block += newline
    return before + block + text[end:]


def _span(text: str, section: str, source: str) -> tuple[int, int, str]:
    """First and one past the last character of a section's lines, and their indentation.

    Comments that are indented deeper than the section's name belong to it, others to what follows.
    A section that is not there begins and ends at the text's end, or before `complete`.
    """
    root = _compose(text, source)
    if root is None:
        return len(text), len(text), ""
    if root.flow_style:
        if not any(key.value == section for key, _ in root.value):
            raise ConfigError(f"{source}: {section}: missing between the braces; write it there")
        return 0, len(text), ""
    keys = [key.start_mark for key, _ in root.value]
    starts = [mark.index - mark.column for mark in keys] + [len(text)]
    column = keys[0].column
    indent = text[starts[0] : starts[0] + column]
    names = [key.value for key, _ in root.value]
    if section not in names:  # `complete: true` stays the last line
        end = starts[names.index("complete")] if names[-1] == "complete" else len(text)
        return end, end, indent
    at = names.index(section)
    start, end = starts[at], starts[at + 1]
    while True:  # leave what is not its own at its end: blank lines, comments, the end mark
        line_start = text.rfind("\n", start, end - 1) + 1
        line = text[line_start:end].rstrip()
        deep = len(line) - len(line.lstrip()) > column
        foreign = line == "..." or (line.lstrip().startswith("#") and not deep)
        if line_start <= start or (line and not foreign):
            return start, end, indent
        end = line_start


def _written(value: Any) -> str:
    """A value as YAML text; a float without an exponent, which YAML 1.1 would read as a word."""
    if isinstance(value, float):
        return np.format_float_positional(value, trim="0")
    with contextlib.suppress(ValueError):
        if isinstance(value, str) and load_yaml(value) == value:
            return value
    return json.dumps(value)

"""YAML read strictly: what would be misunderstood, or could fill the memory, is an error."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from bikeped.errors import ConfigError
from bikeped.files import read_regular

_MAX_NODES = 20_000
_MAX_DEPTH = 20
#: Halves of surrogate pairs, which no UTF-8 text holds, and NUL, which no path holds.
UNUSABLE = re.compile("[\ud800-\udfff\0]")


class _StrictLoader(yaml.SafeLoader):
    """No aliases (a few lines of them can stand for gigabytes), no endless nesting, only characters
    that files and paths can hold, and each key once: PyYAML keeps the last of two equal keys."""

    _depth = 0
    _nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        self._nodes += 1
        if isinstance(event, yaml.AliasEvent):
            problem = "aliases are not allowed, write the value out"
        elif self._depth >= _MAX_DEPTH:
            problem = "nested too deeply"
        elif self._nodes > _MAX_NODES:
            problem = "too many values"
        elif isinstance(event, yaml.ScalarEvent) and UNUSABLE.search(event.value):
            problem = "a character that no text can hold"
        else:
            self._depth += 1
            node: yaml.Node | None = super().compose_node(parent, index)
            self._depth -= 1
            return node
        mark: Any = event.start_mark
        raise yaml.constructor.ConstructorError(problem=problem, problem_mark=mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"{one_line(key.value)} is given twice", problem_mark=key.start_mark
                )
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else key)
        return super().construct_mapping(node, deep)


def load_yaml(text: str) -> Any:
    """The value of a YAML text.

    Raises ValueError with one line, `line N: ` in front where the place is known.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark is not None else ""
        what = getattr(error, "problem", None) or "a character that YAML does not allow"
        raise ValueError(f"{where}is not YAML ({one_line(what)})") from error
    # Odd numbers, dates and explicit tags such as `!!int ''`.
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        raise ValueError(f"is not a usable YAML value ({one_line(str(error))})") from error


def load_sections(text: str, source: str) -> dict[str, Any]:
    """The sections of a configuration's text; ConfigError names `source` and the line."""
    try:
        data = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}; correct it there") from error
    if data is not None and not isinstance(data, dict):
        raise ConfigError(f"{source}: expected sections such as camera: and decision: at the top")
    return data or {}


def read_text(path: Path, remedy: str) -> str:
    """The text of a YAML file, line ends as they are; ConfigError says what to do (`remedy`)."""
    try:
        return read_regular(path).decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text; save it as UTF-8") from error


def one_line(text: str) -> str:
    """A text for a message: on one line, at most 80 characters."""
    flat = " ".join(text.split())
    return flat if len(flat) <= 80 else flat[:77] + "..."

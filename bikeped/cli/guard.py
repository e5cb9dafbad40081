"""Refuses an output that would overwrite an input, and two outputs in one file."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from bikeped.errors import BikepedError

F = TypeVar("F", bound=Callable[..., Any])

#: Parameters that name an input, or an output, and what the command line calls them.
_INPUTS = {
    "video": "VIDEO",
    "scenario": "SCENARIO",
    "config_path": "-c",
    "candidate": "CANDIDATE",
    "scenarios_dir": "--scenarios",
    "added": "--scenario",
    "trace": "--trace",
    "curve_path": "--recall-curve",
    "data": "DATA",
    "images": "IMAGES",
    "models": "MODEL",
    "weights": "WEIGHTS",
    "int8": "--int8",
    "validation": "--validation",
    "challenge": "FILE_OR_LINK",
    "picture": "FRAME",
    "points_path": "--points",
}
_OUTPUTS = {
    "json_path": "--json",
    "overlay": "--overlay",
    "events": "--events",
    "audit_path": "--audit",
    "out": "--out",
    "figure": "--figure",
    "curve_out": "--curve",
    "engine": "--engine",
    "report_path": "--report",
    "board_path": "--board",
    "grid_path": "--grid",
}


def guarded(command: F) -> F:
    """Checks the command's files before it runs; the innermost decorator, right above the function.

    Raises BikepedError when an output is an input (or lies in an input folder and exists), when two
    outputs are one file, and when an output cannot be written.
    """

    @functools.wraps(command)
    def checked(**given: Any) -> Any:
        check_outputs(
            [(_INPUTS[k], p) for k in _INPUTS if k in given for p in _read_paths(given[k])],
            [
                (_shown(k), path)
                for k in _OUTPUTS
                if k in given and not _is_folder(k, given)
                for path in written_paths(given[k])
            ],
        )
        return command(**given)

    return checked  # type: ignore[return-value]


def check_outputs(inputs: Iterable[tuple[str, Path]], outputs: Iterable[tuple[str, Path]]) -> None:
    """See `guarded`; each file is what the command line calls it, and its path."""
    read = [(name, path, path.resolve()) for name, path in inputs if _exists(str(path))]
    written: dict[Path, str] = {}
    for name, path in outputs:
        target = path.resolve()
        for what, source, real in read:
            if target == real or (path.exists() and path.samefile(source)):
                raise BikepedError(
                    f"{name} {path}: is {what}, which would be overwritten; choose another name"
                )
            if real.is_dir() and target.parent == real and path.exists():
                raise BikepedError(
                    f"{name} {path}: lies in {what} {source} and would overwrite what is read from "
                    "there; choose another folder"
                )
        if target in written:
            raise BikepedError(
                f"{name} {path}: is also {written[target]}; give each output its own file"
            )
        written[target] = name
        folder = target.parent
        if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
            raise BikepedError(
                f"{name} {path}: cannot be written; name a file in a folder that exists and that "
                "you may write"
            )


def _parameter(name: str) -> click.Parameter | None:
    context = click.get_current_context(silent=True)
    found = context.command.params if context is not None else []
    return next((p for p in found if p.name == name), None)


def _shown(name: str) -> str:
    """How the command line names an output: its option, or the argument's own word."""
    parameter = _parameter(name)
    if isinstance(parameter, click.Argument):
        return str(parameter.metavar or name.upper())
    return _OUTPUTS[name]


def _is_folder(name: str, given: Mapping[str, Any]) -> bool:
    """Whether an output is a folder: what goes into it has names of its own."""
    parameter = _parameter(name)
    kind = parameter.type if parameter is not None else None
    if isinstance(kind, click.Path) and not kind.file_okay:
        return True
    return name == "out" and given.get("dataset") is not None  # `scene --dataset N --out FOLDER`


def written_paths(value: Any) -> list[Path]:
    """The path of an output parameter as a list, empty for None and for `-` (standard output)."""
    return [] if value is None or value == "-" else [Path(str(value))]


def _read_paths(value: Any) -> list[Path]:
    """The paths of an input: none, one, or several; `NAME=FILE` where a file has a name."""
    if value is None or value == "-":
        return []
    if isinstance(value, (tuple, list)):
        return [path for item in value for path in _read_paths(item)]
    text = str(value)
    return [Path(text.partition("=")[2] if "=" in text and not _exists(text) else text)]


def _exists(text: str) -> bool:
    try:
        return Path(text).exists()
    except (OSError, ValueError):  # a link can be longer than any name
        return False

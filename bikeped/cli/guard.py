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

#: Names of the parameters of all commands that are read, and of those that are written.
_INPUTS = (
    *("video", "scenario", "config_path", "candidate", "scenarios_dir", "added", "trace"),
    *("curve_path", "data", "images", "models", "weights", "int8", "validation", "challenge"),
    *("picture", "points_path", "traffic"),
)
_OUTPUTS = (
    *("json_path", "overlay", "events", "audit_path", "out", "figure", "curve_out", "engine"),
    *("report_path", "board_path", "grid_path", "html_path"),
)


def guarded(command: F) -> F:
    """Checks the command's files before it runs; the innermost decorator, right above the function.

    Raises BikepedError when an output is an input (or lies in an input folder and exists), when two
    outputs are one file, and when an output cannot be written.
    """

    @functools.wraps(command)
    def checked(**given: Any) -> Any:
        parameters = {p.name: p for p in click.get_current_context().command.params}
        read = ((parameters[k], path) for k in _INPUTS for path in _read_paths(given.get(k)))
        files = ((parameters[k], path) for k in _OUTPUTS for path in written_paths(given.get(k)))
        written = [(_label(p), path) for p, path in files if not _is_folder(p, given)]
        check_outputs([(_label(p), path) for p, path in read], written)
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


def _label(parameter: click.Parameter) -> str:
    """What the command line calls a parameter: its option, or the argument's own word."""
    if isinstance(parameter, click.Argument):
        return str(parameter.metavar or parameter.name).removesuffix("...").upper()
    return parameter.opts[0]


def _is_folder(parameter: click.Parameter, given: Mapping[str, Any]) -> bool:
    """Whether an output is a folder: the files in it have names of their own."""
    if isinstance(parameter.type, click.Path) and not parameter.type.file_okay:
        return True
    # `scene --dataset N --out FOLDER`
    return parameter.name == "out" and given.get("dataset") is not None


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

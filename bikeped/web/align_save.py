"""Writing an alignment into config.yaml: the camera's keys that changed, and not a letter more.

The text is edited in place, value by value, so comments and order stay. Then it is read back: the
effective configuration must differ in exactly those keys, or nothing is written.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import msgspec
import yaml

import bikeped
from bikeped.config import load_config, parse_config
from bikeped.config.load import load_yaml
from bikeped.config.provenance import provenance_path
from bikeped.errors import ConfigError
from bikeped.files import write_like

#: All that a page may ever write: how the camera hangs, and its lens.
KEYS = ("height_m", "pitch_deg", "radius_px", "cx", "cy", "heading_deg")
_DIGITS = {"height_m": 4, "pitch_deg": 3, "radius_px": 2, "cx": 2, "cy": 2, "heading_deg": 3}


class ChangedError(ConfigError):
    """The file is not the one that the page was opened with."""


@dataclass(frozen=True)
class Saved:
    """What was done: the files, the keys and values now in the file, the file's new hash."""

    config: Path
    backup: Path
    keys: dict[str, float]
    sha256: str
    promoted: bool  #: whether a promoted decision was measured with the camera as it was


def rounded(values: Mapping[str, float]) -> dict[str, float]:
    """The values as they are written: a tenth of a millimetre, a thousandth of a degree."""
    return {key: round(float(values[key]), _DIGITS[key]) + 0.0 for key in KEYS if key in values}


def file_hash(path: Path) -> str:
    """SHA-256 of the file, that a page remembers to notice other hands."""
    return hashlib.sha256(_read(path).encode()).hexdigest()


def why_not(path: Path) -> str | None:
    """Why the file cannot be saved by this process, in one line; None when it can."""
    target = path.resolve()
    if not target.is_file():
        return f"{path}: is not there; start with -c and a file of your own"
    if target.parent == Path(bikeped.__file__).parent.resolve() / "default":
        return (
            f"{path}: comes with bikeped and stays as it is; start with -c and a file of your own"
        )
    if not (os.access(target.parent, os.W_OK) and os.access(target, os.W_OK)):
        return (
            f"{path}: this process may not write it; copy the lines below into it as a user who "
            "may, or run bikeped align as that user"
        )
    return None


def save(
    path: Path, values: Mapping[str, float], sha256: str, now: datetime | None = None
) -> Saved:
    """Writes `values` (keys of `KEYS`) into the camera section of `path`.

    `sha256` is the hash of the file that the values were made for: ChangedError when it is another
    one now. The file before stays beside it, with the time (UTC) in its name. ConfigError when the
    file cannot be edited without touching the rest, or the values are out of range.
    """
    unknown = [key for key in values if key not in KEYS]
    if unknown or not values:
        raise ConfigError(
            f"{path}: {', '.join(unknown) or 'nothing'} is not for a page to write; it writes "
            f"{', '.join(KEYS)}"
        )
    target = path.resolve()  # a link to the file stays a link
    text = _read(target)
    _check_same(path, text, sha256)
    new = rounded(values)
    after = edit(text, new, str(path))
    _check(text, after, path, new)
    moment = (now or datetime.now(timezone.utc)).strftime("%Y-%m-%d-%H%M%S")
    backup = target.with_name(f"{target.name}.{moment}.bak")
    number = 1
    while backup.exists():
        number += 1
        backup = target.with_name(f"{target.name}.{moment}-{number}.bak")
    write_like(backup, text.encode(), target)
    try:
        _check_same(path, _read(target), sha256)
        write_like(target, after.encode(), target)
    except BaseException:
        backup.unlink(missing_ok=True)
        raise
    return Saved(
        config=target,
        backup=backup,
        keys=new,
        sha256=hashlib.sha256(after.encode()).hexdigest(),
        promoted=provenance_path(target).exists(),
    )


def lines(values: Mapping[str, float]) -> str:
    """The camera section's lines, to be written by hand."""
    return "camera:\n" + "".join(f"  {k}: {_said(v)}\n" for k, v in rounded(values).items())


def edit(text: str, values: Mapping[str, float], source: str) -> str:
    """`text` with these keys of its camera section set; all else stays to the character.

    A comment behind a value keeps its column where the new value leaves room.
    """
    newline = "\r\n" if "\r\n" in text else "\n"
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is not None and not isinstance(root, yaml.MappingNode):
        raise ConfigError(f"{source}: expected sections such as camera: at the top")
    pairs = [] if root is None else root.value
    section = next((value for key, value in pairs if key.value == "camera"), None)
    if section is None:
        if root is not None and root.flow_style:
            raise ConfigError(f"{source}: camera: missing between the braces; write it there first")
        gap = "" if not text or text.endswith("\n") else newline
        return text + gap + lines(values).replace("\n", newline)
    if not isinstance(section, yaml.MappingNode) or not section.value:
        raise ConfigError(
            f"{source}: camera: is empty; write its keys one below the other, or take it out"
        )
    found = {key.value: (key, value) for key, value in section.value}
    edits: list[tuple[int, int, str]] = []
    missing = []
    for name, number in values.items():
        if name not in found:
            missing.append((name, number))
            continue
        old = found[name][1]
        start, end, said = old.start_mark.index, old.end_mark.index, _said(number)
        if start == end:  # `height_m:` with nothing behind it
            said = " " + said
        room = len(text[end:]) - len(text[end:].lstrip(" "))
        if text[end + room : end + room + 1] == "#":
            kept = max(1, room - (len(said) - (end - start)))
            said, end = said + " " * kept, end + room
        edits.append((start, end, said))
    if missing:
        edits.append(_insertion(text, section, missing, newline))
    for start, end, said in sorted(edits, reverse=True):
        text = text[:start] + said + text[end:]
    return text


def _insertion(
    text: str, section: yaml.MappingNode, missing: list[tuple[str, float]], newline: str
) -> tuple[int, int, str]:
    """New keys behind the section's last one."""
    key, value = section.value[-1]
    if section.flow_style:
        at = value.end_mark.index
        return at, at, "".join(f", {name}: {_said(number)}" for name, number in missing)
    first = key.start_mark.index
    indent = text[text.rfind("\n", 0, first) + 1 : first]
    end = text.find("\n", max(first, value.end_mark.index))
    at = len(text) if end < 0 else end + 1
    block = "".join(f"{indent}{name}: {_said(number)}{newline}" for name, number in missing)
    return at, at, (newline if end < 0 else "") + block


def _said(number: float) -> str:
    """A number as people write it; YAML would read 1e-05 as a word."""
    said = f"{number:.4f}".rstrip("0")
    return said + "0" if said.endswith(".") else said


def _check(before: str, after: str, path: Path, values: Mapping[str, float]) -> None:
    """Reads the new text back: these keys have these values, and all else is as it was."""
    old = parse_config(before, str(path), path.parent).config
    try:
        new = parse_config(after, str(path), path.parent).config
    except ConfigError as error:
        if "camera." in str(error):  # a value out of range, in words for people
            raise
        same = False
    else:
        old_data, new_data = load_yaml(before) or {}, load_yaml(after)
        old_data["camera"] = {**(old_data.get("camera") or {}), **values}
        camera = msgspec.structs.replace(old.camera, **values)
        same = new == msgspec.structs.replace(old, camera=camera) and old_data == new_data
    if not same:
        raise ConfigError(
            f"{path}: its camera section cannot be changed without touching the rest, so nothing "
            "was written; copy the lines into it by hand"
        )


def _check_same(path: Path, text: str, sha256: str) -> None:
    if hashlib.sha256(text.encode()).hexdigest() != sha256:
        raise ChangedError(
            f"{path}: was changed by somebody else since this page was opened, so nothing was "
            "written; open the page again"
        )


def _read(path: Path) -> str:
    load_config(path)  # all that is wrong with it, in one line
    return path.read_bytes().decode("utf-8")

"""Writing an alignment: into config.yaml the camera's keys that changed, and beside it what the
camera sees, by which the service notices that it has moved."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import bikeped
from bikeped.config.build import framing, ground_camera
from bikeped.config.edit import completed, section_lines, set_values
from bikeped.config.load import load_config, parse_config
from bikeped.config.provenance import provenance_path
from bikeped.errors import ConfigError, GeometryError
from bikeped.files import write_like
from bikeped.monitor.drift_reference import make_reference
from bikeped.types import ImageArray

#: The only keys that a page may write: the camera's pose and its lens.
KEYS = ("height_m", "pitch_deg", "radius_px", "cx", "cy", "heading_deg")
#: Beside the configuration, where `camera.reference` names no other file.
REFERENCE = "camera_reference.json"
_DIGITS = {"height_m": 4, "pitch_deg": 3, "radius_px": 2, "cx": 2, "cy": 2, "heading_deg": 3}


class ChangedError(ConfigError):
    """The file is not the one that the page was opened with."""


@dataclass(frozen=True)
class Saved:
    """What was written: the files, the keys and values now in the file, the file's new hash.

    `reference` is the file of what the camera sees; None where there is none, for the reason
    `no_reference`.
    """

    config: Path
    backup: Path
    keys: dict[str, float]
    sha256: str
    reference: Path | None
    no_reference: str
    promoted: bool  #: whether there is a promotion, which was measured with the camera as before


def rounded(values: Mapping[str, float]) -> dict[str, float]:
    """The values as they are written: a tenth of a millimetre, a thousandth of a degree."""
    return {key: round(float(values[key]), _DIGITS[key]) + 0.0 for key in KEYS if key in values}


def file_hash(path: Path) -> str:
    """SHA-256 of the file, by which a page notices that the file was changed."""
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
    path: Path,
    values: Mapping[str, float],
    sha256: str,
    now: datetime | None = None,
    picture: ImageArray | None = None,
) -> Saved:
    """Writes `values` (keys of `KEYS`) into the camera section of `path`, and what the camera sees
    in `picture` ([h, w, 3] RGB) into the file that `camera.reference` names then: null without one.

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
    after = set_values(text, {"camera": new}, str(path))
    after = completed(after)
    loaded = parse_config(after, str(path), path.parent)  # names a value that is out of range
    content, no_reference = None, "there is no picture"
    if picture is not None:
        try:
            content = make_reference([picture], ground_camera(loaded), framing(loaded)).to_json()
        except GeometryError as error:
            no_reference = str(error)
    old = loaded.config.camera.reference
    name = None if content is None else old or REFERENCE
    if name != old:
        after = set_values(after, {"camera": {"reference": name}}, str(path))
    reference = None if name is None else loaded.path(name)
    moment = (now or datetime.now(timezone.utc)).strftime("%Y-%m-%d-%H%M%S")
    backup = target.with_name(f"{target.name}.{moment}.bak")
    number = 1
    while backup.exists():
        number += 1
        backup = target.with_name(f"{target.name}.{moment}-{number}.bak")
    write_like(backup, text.encode(), target)
    try:
        _check_same(path, _read(target), sha256)
        if content is not None and reference is not None:
            write_like(reference, content, target)
        write_like(target, after.encode(), target)
    except BaseException:
        backup.unlink(missing_ok=True)
        raise
    return Saved(
        config=target,
        backup=backup,
        keys=new,
        sha256=hashlib.sha256(after.encode()).hexdigest(),
        reference=reference,
        no_reference=no_reference if reference is None else "",
        promoted=provenance_path(target).exists(),
    )


def lines(values: Mapping[str, float]) -> str:
    """The camera section's lines, to be copied by hand."""
    return "\n".join(section_lines("camera", rounded(values))) + "\n"


def _check_same(path: Path, text: str, sha256: str) -> None:
    if hashlib.sha256(text.encode()).hexdigest() != sha256:
        raise ChangedError(
            f"{path}: the file changed after this page was opened, so nothing was written; open "
            "the page again"
        )


def _read(path: Path) -> str:
    load_config(path)  # all that is wrong with it, in one line
    return path.read_bytes().decode("utf-8")

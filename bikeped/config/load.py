"""Reading, overriding and hashing a configuration and its `camera_calibration.json`."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from bikeped.config.lens_check import Calibration, check_calibration
from bikeped.config.schema import Config, DecisionConfig
from bikeped.config.strict_yaml import UNUSABLE, load_sections, load_yaml, one_line, read_text
from bikeped.config.validate import check_together, to_config
from bikeped.errors import CalibrationError, ConfigError
from bikeped.files import read_regular
from bikeped.models import BUNDLED

_PATH_KEYS = (
    *("camera.calibration", "detection.model", "detection.engine_cache", "audit.path"),
    *("feedback.sound.chime", "feedback.sound.bell", "web.token_file"),
    *("camera.password_file", "mqtt.password_file"),
    *("mqtt.ca_file", "mqtt.cert_file", "mqtt.key_file"),
)


@dataclass(frozen=True)
class LoadedConfig:
    """A checked configuration with what it was made from.

    `source` names it in messages; relative paths in it start at `base_dir`. `hash` covers every
    effective value, `calibration_hash` the calibration file's bytes (None without one). `text` and
    `calibration_data` are what was read; `named` are the keys, as `camera.source`, that the file or
    an override gives.
    """

    config: Config
    source: str
    base_dir: Path
    hash: str
    calibration: Calibration | None
    calibration_hash: str | None
    text: str = field(default="", repr=False)
    calibration_data: bytes | None = field(default=None, repr=False)
    named: frozenset[str] = frozenset()

    def path(self, relative: str) -> Path:
        """A path of the configuration, resolved against the folder of its file."""
        return (self.base_dir / _expanded(relative)).absolute()


def default_config_path() -> Path:
    """`config.yaml` in the working directory, or else the one that comes with bikeped."""
    here = Path("config.yaml")
    if here.is_file():
        return here
    package = Path(__file__).parent.parent
    bundled = package / "default" / "config.yaml"
    return bundled if bundled.is_file() else package.parent / "config.yaml"


def load_config(path: Path | None = None, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Reads a configuration file, applies `SECTION.KEY=VALUE` overrides and checks all of it.

    Raises ConfigError (or CalibrationError) with one line naming the file, the key and the remedy.
    Paths in an override are relative to the working directory, as a person would type them.
    """
    file = path if path is not None else default_config_path()
    text = read_text(file, "give a configuration with -c")
    return parse_config(text, str(file), file.parent, overrides)


def parse_config(
    text: str,
    source: str,
    base_dir: Path,
    overrides: Sequence[str] = (),
    calibration_file: Path | None = None,
) -> LoadedConfig:
    """A configuration from YAML text; see `load_config`.

    `calibration_file` is read in place of the one that `camera.calibration` names.
    """
    data = load_sections(text, source)
    for override in overrides:
        _apply_override(data, override)
    where = source if not overrides else f"{source} with --set"
    config = to_config(data, where)
    check_together(config, where)
    calibration, calibration_data = None, None
    if config.camera.calibration is not None:
        file = calibration_file or base_dir / _expanded(config.camera.calibration)
        calibration, calibration_data = load_calibration(file)
        check_calibration(calibration, config.camera, str(file))
    calibration_hash = None
    if calibration_data is not None:
        calibration_hash = hashlib.sha256(calibration_data).hexdigest()
    return LoadedConfig(
        config=config,
        source=source,
        base_dir=base_dir,
        hash=config_hash(config, calibration_hash),
        calibration=calibration,
        calibration_hash=calibration_hash,
        text=text,
        calibration_data=calibration_data,
        named=frozenset(_names(data)),
    )


def _names(data: dict[str, Any], path: str = "") -> Iterator[str]:
    """The keys of nested sections as `section.key`."""
    for name, value in data.items():
        if isinstance(value, dict):
            yield from _names(value, f"{path}{name}.")
        else:
            yield f"{path}{name}"


def load_calibration(path: Path) -> tuple[Calibration, bytes]:
    """The calibration and the bytes of its file; CalibrationError names file, key and remedy."""
    try:
        data = read_regular(path)
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be read ({error.strerror}); correct camera.calibration, or set it "
            "to null and give camera.radius_px and camera.fov_deg"
        ) from error
    try:
        calibration = msgspec.json.decode(data, type=Calibration)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"{path}: {error}; compare it with the camera_calibration.json that comes with bikeped"
        ) from error
    return calibration, data


def load_decision(path: Path, overrides: Sequence[str] = ()) -> DecisionConfig:
    """The decision section of a candidate file, or of a whole configuration.

    Keys that the section leaves out take their defaults. `overrides` are `decision.KEY=VALUE`.
    Raises ConfigError as `load_config` does.
    """
    return parse_decision(read_text(path, "check the path"), str(path), overrides)


def parse_decision(text: str, source: str, overrides: Sequence[str] = ()) -> DecisionConfig:
    """As `load_decision`, from YAML text; `source` names it in errors."""
    data = load_sections(text, source)
    if not isinstance(data.get("decision"), dict):
        raise ConfigError(
            f"{source}: decision: missing; a candidate holds a decision: section, or is a whole "
            "configuration"
        )
    for override in overrides:
        _apply_override(data, override)
    return to_config(data, source).decision


def config_hash(config: Config, calibration_hash: str | None = None) -> str:
    """SHA-256 over every effective value and the calibration, independent of how it was written."""
    values = msgspec.to_builtins(config)
    del values["complete"]  # says something of the file, nothing of what it sets
    digest = hashlib.sha256(msgspec.json.encode(values, order="deterministic"))
    digest.update((calibration_hash or "").encode())
    return digest.hexdigest()


def _expanded(path: str) -> Path:
    """With `~` and `~user` replaced; an unknown user's stays, and is then not found."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def _apply_override(data: dict[str, Any], override: str) -> None:
    """Sets a key of `data` from `SECTION.KEY=VALUE`."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    option = f"--set {one_line(override)}"
    if not equals or len(parts) < 2 or not all(parts):
        raise ConfigError(f"{option}: expected SECTION.KEY=VALUE, e.g. --set decision.d_max_m=20")
    if UNUSABLE.search(key):
        raise ConfigError(f"{option}: a character that no key holds; remove it")
    try:
        value = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{option}: {error}; quote the value") from error
    if key.strip() in _PATH_KEYS and isinstance(value, str) and value not in ("", BUNDLED):
        value = str(_expanded(value).absolute())
    node = data
    for part in parts[:-1]:
        if node.get(part) is None:
            node[part] = {}
        node = node[part]
        if not isinstance(node, dict):
            raise ConfigError(f"{option}: {part} is not a section; name one with its key")
    node[parts[-1]] = value

"""Reading, overriding, checking and hashing a configuration."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import yaml

from bikeped.config.calibration_file import Calibration, load_calibration
from bikeped.config.schema.inputs import Config
from bikeped.config.schema.outputs import is_loopback
from bikeped.errors import ConfigError
from bikeped.models import BUNDLED

_MAX_BYTES = 1_000_000
_MAX_NODES = 20_000
_MAX_DEPTH = 20
#: What PyYAML raises beside YAMLError, on odd numbers, dates and explicit tags (`!!int ''`).
_YAML_TROUBLE = (
    ValueError,
    OverflowError,
    RecursionError,
    TypeError,
    LookupError,
    AttributeError,
)
#: Halves of surrogate pairs, which no UTF-8 text holds, and NUL, which no path holds.
_UNUSABLE = re.compile("[\ud800-\udfff\0]")


@dataclass(frozen=True)
class LoadedConfig:
    """A checked configuration with what it was made from.

    `source` names it in messages; relative paths in it start at `base_dir`. `hash` covers every
    effective value, `calibration_hash` the calibration file's bytes (None without one).
    """

    config: Config
    source: str
    base_dir: Path
    hash: str
    calibration: Calibration | None
    calibration_hash: str | None

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

    Raises ConfigError (or CalibrationError) with one line naming the file, the key and the mend.
    Paths given by an override are relative to the working directory, as a person would type them.
    """
    file = path if path is not None else default_config_path()
    text = read_text(file, "give a configuration with -c")
    return parse_config(text, str(file), file.parent, overrides)


def read_text(path: Path, remedy: str) -> str:
    """The text of a YAML file, line ends as they are; ConfigError says what to do (`remedy`)."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{path}: larger than 1 MB; a configuration is a short text")
        return path.read_bytes().decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text; save it as UTF-8") from error


def parse_config(
    text: str, source: str, base_dir: Path, overrides: Sequence[str] = ()
) -> LoadedConfig:
    """A configuration from YAML text; see `load_config`."""
    data = _yaml_mapping(text, source)
    for override in overrides:
        _apply(data, override)
    where = source if not overrides else f"{source} with --set"
    try:
        config = msgspec.convert(data, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {_explain(error, data)}") from error
    except (ValueError, OverflowError, RecursionError) as error:
        raise ConfigError(f"{where}: {error}; see bikeped config schema") from error
    _cross_check(config, where)
    calibration, calibration_hash = None, None
    if config.camera.calibration is not None:
        file = base_dir / _expanded(config.camera.calibration)
        calibration, calibration_hash = load_calibration(file)
        _check_fit(config, calibration, str(file))
    return LoadedConfig(
        config=config,
        source=source,
        base_dir=base_dir,
        hash=config_hash(config, calibration_hash),
        calibration=calibration,
        calibration_hash=calibration_hash,
    )


def config_hash(config: Config, calibration_hash: str | None = None) -> str:
    """SHA-256 over every effective value and the calibration, independent of how it was written."""
    digest = hashlib.sha256(msgspec.json.encode(config, order="deterministic"))
    digest.update((calibration_hash or "").encode())
    return digest.hexdigest()


def _yaml_mapping(text: str, source: str) -> dict[str, Any]:
    try:
        data = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}; correct it there") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: expected sections such as camera: and decision: at the top")
    return data


class StrictLoader(yaml.SafeLoader):
    """YAML as people's files need it: everything that would be misunderstood is an error.

    No aliases (a few lines of them can stand for gigabytes), no endless nesting, only characters
    that files and paths can hold, and each key once: PyYAML keeps the last of two equal keys, and a
    section that is not heeded must not go unseen.
    """

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
        elif isinstance(event, yaml.ScalarEvent) and _UNUSABLE.search(event.value):
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
                    problem=f"{_one_line(key.value)} stands twice", problem_mark=key.start_mark
                )
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else key)
        return super().construct_mapping(node, deep)


def load_yaml(text: str) -> Any:
    """The value of a YAML text, read strictly.

    Raises ValueError with one line, `line N: ` in front where the place is known.
    """
    try:
        return yaml.load(text, Loader=StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark is not None else ""
        what = getattr(error, "problem", None) or "a character that YAML does not allow"
        raise ValueError(f"{where}is not YAML ({_one_line(what)})") from error
    except _YAML_TROUBLE as error:
        raise ValueError(f"is not a usable YAML value ({_one_line(str(error))})") from error


def _expanded(path: str) -> Path:
    """With `~` and `~user` replaced; an unknown user's stays, and is then not found."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def _apply(data: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    said = f"--set {_one_line(override)}"
    if not equals or len(parts) < 2 or not all(parts):
        raise ConfigError(f"{said}: expected SECTION.KEY=VALUE, e.g. --set decision.d_max_m=20")
    if _UNUSABLE.search(key):
        raise ConfigError(f"{said}: a character that no key holds; take it out")
    try:
        value = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{said}: {error}; quote the value") from error
    if key.strip() in _PATH_KEYS and isinstance(value, str) and value not in ("", BUNDLED):
        value = str(_expanded(value).absolute())
    node = data
    for part in parts[:-1]:
        child = node.get(part)
        if child is None:
            child = node[part] = {}
        if not isinstance(child, dict):
            raise ConfigError(f"{said}: {part} is not a section; name one with its key")
        node = child
    node[parts[-1]] = value


_PATH_KEYS = frozenset(
    {
        "camera.calibration",
        "detection.model",
        "detection.engine_cache",
        "feedback.sound.chime",
        "feedback.sound.bell",
        "mqtt.password_file",
        "mqtt.ca_file",
        "mqtt.cert_file",
        "mqtt.key_file",
        "web.token_file",
        "audit.path",
    }
)


def known_keys(struct: type[msgspec.Struct] = Config, prefix: str = "") -> Iterable[str]:
    """Every key as `section.key`, nested sections included."""
    for item in msgspec.structs.fields(struct):
        name = f"{prefix}{item.name}"
        if isinstance(item.type, type) and issubclass(item.type, msgspec.Struct):
            yield from known_keys(item.type, f"{name}.")
        else:
            yield name


def _section_names(path: str) -> list[str]:
    """Names that may stand at `$.a.b`."""
    struct: type[msgspec.Struct] = Config
    for part in [p for p in path.removeprefix("$").split(".") if p]:
        kinds = {f.name: f.type for f in msgspec.structs.fields(struct)}
        kind = kinds.get(part)
        if not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            return []
        struct = kind
    return [f.name for f in msgspec.structs.fields(struct)]


def _explain(error: msgspec.ValidationError, data: dict[str, Any]) -> str:
    """msgspec's message as key, what is wrong, and the mend."""
    text = str(error)
    body, _, path = text.partition(" - at `")
    path = path.rstrip("`")
    unknown = re.match(r"Object contains unknown field `(.*)`$", body, re.DOTALL)
    if unknown:
        name = unknown.group(1)
        section = path.removeprefix("$").removeprefix(".")
        names = _section_names(path)
        near = difflib.get_close_matches(name, names, 1, 0.5)
        elsewhere = [k for k in known_keys() if k.split(".")[-1] == name]
        if near:
            mend = f"did you mean {near[0]}?"
        elif elsewhere:
            mend = f"did you mean {elsewhere[0]}?"
        else:
            mend = f"known here: {', '.join(names)}"
        key = _one_line(f"{section}.{name}" if section else name)
        return f"{key}: unknown key; {mend}"
    if path.startswith("key` in"):
        section = path.removeprefix("key` in `$").removeprefix(".") or "top level"
        return f"{_one_line(section)}: a key is not text; keys are words such as camera"
    key = path.removeprefix("$").removeprefix(".")
    value = _value_at(data, key)
    got = f" (got {_shown(value)})" if value is not None else ""
    label = _one_line(key) or "top level"
    mend = _allowed(key) or "see bikeped config schema"
    return f"{label}: {_one_line(body[:1].lower() + body[1:])}{got}; {mend}"


def _allowed(key: str) -> str:
    """The values that a key takes, in words; empty where the schema has no short answer."""
    _, parts = msgspec.json.schema_components([Config], ref_template="{name}")
    node: dict[str, Any] = parts["Config"]
    for name in key.partition("[")[0].split("."):
        item = node.get("properties", {}).get(name)
        if item is None:
            return ""
        reference = item.get("$ref") or next(
            (a["$ref"] for a in item.get("allOf", item.get("anyOf", ())) if "$ref" in a), None
        )
        node = parts.get(str(reference), item)
    choices = [node, *node.get("anyOf", ())]
    if "[" in key and isinstance(node.get("items"), dict):
        choices = [node["items"]]
    names = [str(n) for c in choices for n in c.get("enum", ()) if n is not None]
    if names:
        return f"use one of {', '.join(names)}"
    for choice in choices:
        low = choice.get("minimum", choice.get("exclusiveMinimum"))
        high = choice.get("maximum")
        if low is not None and high is not None:
            above = "above " if "exclusiveMinimum" in choice else ""
            return f"use a value {above}{low:g} to {high:g}"
    return ""


def _one_line(text: str) -> str:
    flat = " ".join(text.split())
    return flat if len(flat) <= 80 else flat[:77] + "..."


def _shown(value: object) -> str:
    try:
        return _one_line(repr(value))
    except ValueError:  # a whole number of thousands of digits
        return "a huge number"


def _value_at(data: Any, key: str) -> Any:
    node = data
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return None
        node = node[part]
    return node


def _cross_check(config: Config, where: str) -> None:
    """What no single key can say."""
    decision, camera, mqtt, web = config.decision, config.camera, config.mqtt, config.web
    if decision.d_min_m > decision.d_max_m:
        raise ConfigError(
            f"{where}: decision.d_min_m: {decision.d_min_m:g} is above decision.d_max_m "
            f"{decision.d_max_m:g}; exchange them"
        )
    if (camera.radius_px is None) != (camera.fov_deg is None) and camera.calibration is None:
        raise ConfigError(
            f"{where}: camera.radius_px and camera.fov_deg: without a calibration both are "
            "needed, for they give the focal length; set both"
        )
    if camera.calibration is None and camera.radius_px is None:
        raise ConfigError(
            f"{where}: camera.calibration: missing; name a calibration file, or set "
            "camera.radius_px and camera.fov_deg"
        )
    if (mqtt.cert_file is None) != (mqtt.key_file is None):
        raise ConfigError(
            f"{where}: mqtt.cert_file and mqtt.key_file: one without the other; set both"
        )
    if web.enabled and web.token_file is None and not is_loopback(web.host):
        raise ConfigError(
            f"{where}: web.host: {_one_line(web.host)} can be reached by others, who would see the "
            "camera's picture; set web.token_file too, or web.host: 127.0.0.1"
        )


def _check_fit(config: Config, calibration: Calibration, file: str) -> None:
    """A calibration speaks of one framing only."""
    camera = config.camera
    for key, measured, configured in (
        ("crop_size", calibration.crop_size, camera.crop_size),
        ("pad_size", calibration.pad_size, camera.pad_size),
        ("width", calibration.frame_width, camera.width),
        ("height", calibration.frame_height, camera.height),
    ):
        if measured is not None and measured != configured:
            raise ConfigError(
                f"{file}: does not fit: camera.{key} is {configured}, the calibration was made "
                f"with {measured}; set camera.{key}: {measured} or calibrate again"
            )
    if camera.crop_size is not None and not (
        0 <= calibration.cx <= camera.crop_size and 0 <= calibration.cy <= camera.crop_size
    ):
        raise ConfigError(
            f"{file}: does not fit: centre ({calibration.cx:g}, {calibration.cy:g}) lies outside "
            f"the crop of {camera.crop_size} px; calibrate again with this crop"
        )

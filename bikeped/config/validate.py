"""From the data of a YAML file to a checked Config, and from what is wrong to one line."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from typing import Any

import msgspec

from bikeped.config.output_sections import is_loopback
from bikeped.config.schema import Config, sections
from bikeped.config.strict_yaml import one_line
from bikeped.errors import ConfigError

#: Keys of older versions, and what stands for them now.
_RENAMED = {
    "feedback.hold_alert_s": "decision.alert_hold_s",
    "tracking.position_weight": "tracking.measurement_noise_pedestrian_m, and _cyclist_m",
    "tracking.velocity_weight": "tracking.acceleration_pedestrian_mps2, and _cyclist_mps2",
}


def to_config(data: dict[str, Any], source: str) -> Config:
    """The configuration that `data` holds; ConfigError names `source`, the key and the remedy."""
    try:
        config = msgspec.convert(data, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {_explain(error, data)}") from error
    except (ValueError, OverflowError, RecursionError) as error:
        raise ConfigError(f"{source}: {error}; see bikeped config schema") from error
    decision = config.decision
    if decision.d_min_m > decision.d_max_m:
        raise ConfigError(
            f"{source}: decision.d_min_m: {decision.d_min_m:g} is above decision.d_max_m "
            f"{decision.d_max_m:g}; exchange them"
        )
    return config


def check_together(config: Config, source: str) -> None:
    """Checks keys that depend on one another; ConfigError as `to_config`."""
    camera, decision, mqtt, web = config.camera, config.decision, config.mqtt, config.web
    if camera.calibration is None and None in (camera.radius_px, camera.fov_deg):
        problem = "camera.calibration: missing; name a calibration file, or set both "
        problem += "camera.radius_px and camera.fov_deg"
    elif decision.alert_on_frames > decision.alert_window_frames:
        problem = f"decision.alert_on_frames: {decision.alert_on_frames} of "
        problem += f"{decision.alert_window_frames} frames (decision.alert_window_frames); lower it"
    elif camera.password_file is not None and camera.username is None:
        problem = "camera.password_file: without camera.username; set it too"
    elif (mqtt.cert_file is None) != (mqtt.key_file is None):
        problem = "mqtt.cert_file and mqtt.key_file: one without the other; set both"
    elif re.search(r"[\s/@?#]", mqtt.host) or re.fullmatch(r"[^:]*:\d+", mqtt.host):
        problem = f"mqtt.host: {one_line(mqtt.host)} is no host; give its name or address alone, "
        problem += "e.g. broker.lan, and the port as mqtt.port"
    elif web.enabled and web.token_file is None and not is_loopback(web.host):
        problem = f"web.host: {one_line(web.host)} can be reached by others, who would see the "
        problem += "camera's picture; set web.token_file too, or web.host: 127.0.0.1"
    else:
        return
    raise ConfigError(f"{source}: {problem}")


def known_keys() -> Iterator[str]:
    """Every key as `section.key`, a nested section's after those of the section that holds it."""
    for path, section in sections(Config):
        inner = {name for name, _ in sections(Config)}
        for field in msgspec.structs.fields(section):
            name = f"{path}.{field.name}" if path else field.name
            if name not in inner:
                yield name


def _explain(error: msgspec.ValidationError, data: dict[str, Any]) -> str:
    """msgspec's message as the key, what is wrong, and the remedy."""
    body, _, path = str(error).partition(" - at `")
    path = path.rstrip("`").removeprefix("$").removeprefix(".")
    unknown = re.match(r"Object contains unknown field `(.*)`$", body, re.DOTALL)
    if unknown:
        return _explain_unknown(path, unknown.group(1))
    if path.startswith("key` in"):
        section = path.removeprefix("key` in `$").removeprefix(".") or "top level"
        return f"{one_line(section)}: a key is not text; keys are words such as camera"
    value: Any = data
    for part in path.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    try:
        got = "" if value is None else f" (got {one_line(repr(value))})"
    except ValueError:  # a whole number of thousands of digits
        got = " (got a huge number)"
    remedy = _allowed(path) or "see bikeped config schema"
    label = one_line(path) or "top level"
    return f"{label}: {one_line(body[:1].lower() + body[1:])}{got}; {remedy}"


def _explain_unknown(section: str, name: str) -> str:
    """The key's new name, the nearest known key of the section, a key of that name elsewhere, or
    all of the section."""
    if renamed := _RENAMED.get(f"{section}.{name}"):
        return f"{section}.{name}: is now {renamed}; write it there"
    struct = dict(sections(Config)).get(section)
    names = [] if struct is None else [field.name for field in msgspec.structs.fields(struct)]
    elsewhere = [key for key in known_keys() if key.split(".")[-1] == name]
    near = [*difflib.get_close_matches(name, names, 1, 0.5), *elsewhere]
    remedy = f"did you mean {near[0]}?" if near else f"known here: {', '.join(names)}"
    return f"{one_line(f'{section}.{name}' if section else name)}: unknown key; {remedy}"


def _allowed(key: str) -> str:
    """The values that a key takes, in words; empty where the schema has no short answer."""
    path, item, _ = key.partition("[")
    section, _, name = path.rpartition(".")
    struct = dict(sections(Config)).get(section)
    if struct is None:
        return ""
    properties = msgspec.json.schema(Config)["$defs"][struct.__name__]["properties"]
    node = properties.get(name, {})
    choices = [node["items"]] if item and "items" in node else [node, *node.get("anyOf", ())]
    names = [str(n) for choice in choices for n in choice.get("enum", ()) if n is not None]
    if names:
        return f"use one of {', '.join(names)}"
    for choice in choices:
        low = choice.get("minimum", choice.get("exclusiveMinimum"))
        high = choice.get("maximum")
        if low is not None and high is not None:
            above = "above " if "exclusiveMinimum" in choice else ""
            return f"use a value {above}{low:g} to {high:g}"
    return ""

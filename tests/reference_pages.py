"""Writes the pages of docs/ that are made from the code; tests hold that they are current.

`python tests/reference_pages.py` writes the configuration's keys, the table of faults, the JSON
Schema of every message, and the picture of the house.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import architecture_picture
import msgspec

from bikeped.config.json_schema import json_schema, key_descriptions
from bikeped.config.schema import Config, sections
from bikeped.faults import FAULT_KINDS
from bikeped.files import write_whole
from bikeped.telemetry import schema as messages

DOCS = Path(__file__).parent.parent / "docs"

#: file name (before .schema.json) -> type of the payload
MESSAGES: dict[str, Any] = {
    "tracks": messages.TracksMessage,
    "state": messages.StateMessage,
    "health": messages.HealthMessage,
    "availability": messages.Availability,
    "event-header": messages.EventHeader,
    "event-frame": messages.EventLine,
}


def message_schema(name: str) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of one message by its name in `MESSAGES`."""
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "title": f"bikeped {name}", **msgspec.json.schema(MESSAGES[name])}


def pages() -> dict[Path, str]:
    """The text of every page by its path."""
    schemas = {
        DOCS / "messages" / f"{name}.schema.json": json.dumps(
            message_schema(name), indent=2, ensure_ascii=False
        )
        + "\n"
        for name in MESSAGES
    }
    return {
        DOCS / "configuration.md": configuration_page(),
        DOCS / "faults-reference.md": faults_page(),
        architecture_picture.PICTURE: architecture_picture.draw() + "\n",
        **schemas,
    }


_CONFIGURATION = """\
# Configuration

<!-- Made by `python tests/reference_pages.py` from the sections in bikeped/config; change the
     descriptions there. -->

Every key of `config.yaml`, in the order of the file. A key that is left out has its default. An
unknown key is an error that names the nearest known one, and so is a key that is given twice.
`bikeped config check` reports what is wrong with a file, `bikeped config show` prints the whole
effective configuration, and `--set SECTION.KEY=VALUE` on the command line overrides one key, for
example `--set decision.d_max_m=20 --set feedback.gpio.red=12`.

**Frames and seconds.** `decision.memory_frames`, `decision.lookback_frames`,
`tracking.speed_window_frames` and `latency.frames` count nominal frames, as the paper gives them.
They become seconds once, at the start, by `decision.nominal_fps`: with `memory_frames: 58` and
30 frames per second a cyclist is remembered 1.93 s, also when the camera delivers 25 frames per
second or drops some. `tracking.history_frames` and `feedback.recover_frames` count the frames
that arrive. Keys that end in `_s` are seconds; `_m` metres, `_px` pixels, `_deg` degrees, `_mps`
metres per second.

**Paths.** A relative path starts at the folder of the configuration file, or, given with `--set`,
at the working directory; `~` is the home directory.

**Whole files.** The last line of a file is `complete: true`. A file that was cut off, by a full
disk or a loss of power, lacks it: `bikeped config check` and `bikeped run` warn of a file without
it, and where the last good copy had it (`bikeped run --last-good`) such a file is not used.
`bikeped run` wants `camera.source` and `feedback.light` in the file, and `feedback.gpio.chip`
or `feedback.usb.device` beside them: what drives hardware has no silent default.

**Numbers.** YAML reads `1e-3` as text: write `0.001`.
"""


def configuration_page() -> str:
    """docs/configuration.md: one table a section, nested sections after the one that holds them."""
    parts = json_schema()["$defs"]
    lines = [_CONFIGURATION]
    for path, section in sections(Config):
        keys = key_descriptions(section)
        if not keys:
            continue
        lines += [f"## {path or 'top level'}", "", " ".join((section.__doc__ or "").split()), ""]
        lines += ["| key | values | default | meaning |", "| --- | --- | --- | --- |"]
        for key, text in keys.items():
            item = parts[section.__name__]["properties"][key]
            row = (
                f"`{path}.{key}`" if path else f"`{key}`",
                _values(item),
                f"`{_yaml(item['default'])}`",
                text,
            )
            lines.append(f"| {' | '.join(map(_escaped, row))} |")
        lines.append("")
    return "\n".join(lines)


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|").replace("<", "&lt;")


def _yaml(value: object) -> str:
    """A default as YAML."""
    if isinstance(value, str):
        return f'"{value}"' if value == "off" or not value else value
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_yaml, value))}]"
    return msgspec.json.encode(value).decode()


def _values(item: dict[str, Any]) -> str:
    """The values that a key takes, in words."""
    if "anyOf" in item:
        return " or ".join(_values(choice) for choice in item["anyOf"])
    if "enum" in item:
        return ", ".join(f"`{_yaml(name)}`" for name in item["enum"])
    kind = item["type"]
    if kind == "array":
        return f"list of {_values(item['items'])}"
    if word := {"boolean": "`true` or `false`", "string": "text", "null": "`null`"}.get(kind):
        return word
    name = "whole number" if kind == "integer" else "number"
    high = item["maximum"]
    if "exclusiveMinimum" in item:
        return f"{name} above {item['exclusiveMinimum']:.7g} to {high:.7g}"
    return f"{name} {item['minimum']:.7g} to {high:.7g}"


_FAULTS = """\
# Faults

<!-- Made by `python tests/reference_pages.py` from the table in bikeped/faults.py; change it
     there. -->

What can be wrong, and what each fault does. The codes stand in `fault_codes` of the
[health message](messages/README.md), beside the lines for people in `faults`. A fault whose light
is FAULT makes the light blink orange, never blue or green; where it says "for IDLE and SAFE" the
light blinks orange in place of blue and green, and WARNING and ALERT show as decided; one with an
exit status also ends the process, so that systemd starts a fresh one.

"""


def faults_page() -> str:
    """docs/faults-reference.md: one row a fault."""
    rows = [
        (
            f"`{kind.code}`",
            kind.meaning,
            kind.effect.value,
            kind.component,
            kind.severity.name.lower(),
            kind.clears.value,
            "" if kind.exit_status is None else str(kind.exit_status),
        )
        for kind in FAULT_KINDS.values()
    ]
    head = ("code", "meaning", "light", "component", "severity", "clears", "exit status")
    lines = [f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows)]
    return _FAULTS + "\n".join(lines) + "\n"


if __name__ == "__main__":
    for path, text in pages().items():
        write_whole(path, text)

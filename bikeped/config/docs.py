"""`python -m bikeped.config.docs docs/configuration.md` writes the page from `sections.py`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from bikeped.config.schema.inputs import Config
from bikeped.files import write_whole

_INTRO = """\
# Configuration

<!-- Made by `python -m bikeped.config.docs docs/configuration.md` from the sections in
     bikeped/config; change the descriptions there. -->

Every key of `config.yaml`, in the order of the file. A key that is left out has its default; a
key that is not listed here stops the start with its name and the nearest known one. A key may
stand only once. `bikeped config check` says what is wrong with a file, `bikeped config show`
prints the whole effective configuration, and `--set SECTION.KEY=VALUE` on the command line
overrides one key, for example `--set decision.d_max_m=20 --set feedback.gpio.red=12`.

**Frames and seconds.** `decision.memory_frames`, `decision.lookback_frames`,
`tracking.speed_window_frames` and `latency.frames` count nominal frames, as the paper gives them.
They become seconds once, at the start, by `decision.nominal_fps`: with `memory_frames: 58` and
30 frames per second a cyclist is remembered 1.93 s, also when the camera delivers 25 frames per
second or drops some. `tracking.history_frames` and `feedback.recover_frames` count the frames that
really come. Keys that end in `_s` are seconds; `_m` metres, `_px` pixels, `_deg` degrees, `_mps`
metres per second.

**Paths.** A relative path starts at the folder of the configuration file, one that is given with
`--set` at the working directory; `~` is the home directory.

**Numbers.** YAML reads `1e-3` as a word: write `0.001`.
"""


def markdown() -> str:
    """The page: one table a section, nested sections after the one that holds them."""
    _, parts = msgspec.json.schema_components([Config], ref_template="{name}")
    lines = [_INTRO]
    for path, struct in _sections(Config, ""):
        properties = parts[struct.__name__]["properties"]
        lines += [f"## {path}", "", " ".join((struct.__doc__ or "").split()), ""]
        lines += ["| key | values | default | meaning |", "| --- | --- | --- | --- |"]
        for field in msgspec.structs.fields(struct):
            if _is_section(field.type):
                continue
            item = properties[field.encode_name]
            row = (
                f"`{path}.{field.encode_name}`",
                _values(item),
                f"`{_yaml(item['default'])}`",
                item["description"],
            )
            lines.append(f"| {' | '.join(map(_escaped, row))} |")
        lines.append("")
    return "\n".join(lines)


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _sections(
    struct: type[msgspec.Struct], prefix: str
) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    for field in msgspec.structs.fields(struct):
        if _is_section(field.type):
            path = f"{prefix}{field.encode_name}"
            yield path, field.type
            yield from _sections(field.type, f"{path}.")


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|").replace("<", "&lt;")


def _yaml(value: object) -> str:
    """A default as one writes it in YAML."""
    if isinstance(value, str):
        return f'"{value}"' if value == "off" or not value else value
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_yaml, value))}]"
    return msgspec.json.encode(value).decode()


def _values(item: dict[str, Any]) -> str:
    """What a key takes, in words."""
    if "anyOf" in item:
        return " or ".join(_values(choice) for choice in item["anyOf"])
    if "enum" in item:
        return ", ".join(f"`{_yaml(name)}`" for name in item["enum"])
    kind = item["type"]
    if kind == "array":
        return f"list of {_values(item['items'])}"
    words = {"boolean": "`true` or `false`", "string": "text", "null": "`null`"}
    if kind in words:
        return words[kind]
    name = "whole number" if kind == "integer" else "number"
    high = item["maximum"]
    if "exclusiveMinimum" in item:
        return f"{name} above {item['exclusiveMinimum']:.7g} to {high:.7g}"
    return f"{name} {item['minimum']:.7g} to {high:.7g}"


def main(arguments: list[str]) -> int:
    """Writes the page to the file named, or to standard output."""
    if arguments:
        write_whole(Path(arguments[0]), markdown())
    else:
        sys.stdout.write(markdown())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

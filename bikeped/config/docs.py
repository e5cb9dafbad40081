"""The JSON Schema and the page of all keys, both from `config/schema.py`.

`python -m bikeped.config.docs docs/configuration.md` writes the page.
"""

from __future__ import annotations

import ast
import inspect
import sys
from pathlib import Path
from typing import Any

import msgspec

from bikeped.config.schema import Config, sections
from bikeped.files import write_whole

_INTRO = """\
# Configuration

<!-- Made by `python -m bikeped.config.docs docs/configuration.md` from bikeped/config/schema.py;
     change the descriptions there. -->

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

**Numbers.** YAML reads `1e-3` as text: write `0.001`.
"""


def json_schema() -> dict[str, Any]:
    """The JSON Schema of config.yaml, every key with its description."""
    schema = msgspec.json.schema(Config)
    for _, section in sections(Config):
        properties = schema["$defs"][section.__name__]["properties"]
        for key, text in key_descriptions(section).items():
            properties[key]["description"] = text
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def key_descriptions(section: type[msgspec.Struct]) -> dict[str, str]:
    """What each key of a section means: the text below it in the source."""
    [tree] = ast.parse(inspect.getsource(section)).body
    assert isinstance(tree, ast.ClassDef)  # noqa: S101 - for the type checker
    return {
        ast.unparse(key.target): " ".join(ast.literal_eval(text.value).split())
        for key, text in zip(tree.body, tree.body[1:], strict=False)
        if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def markdown() -> str:
    """The page: one table a section, nested sections after the one that holds them."""
    parts = json_schema()["$defs"]
    lines = [_INTRO]
    for path, section in sections(Config):
        keys = key_descriptions(section)
        if not keys:
            continue
        lines += [f"## {path}", "", " ".join((section.__doc__ or "").split()), ""]
        lines += ["| key | values | default | meaning |", "| --- | --- | --- | --- |"]
        for key, text in keys.items():
            item = parts[section.__name__]["properties"][key]
            row = (f"`{path}.{key}`", _values(item), f"`{_yaml(item['default'])}`", text)
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


def main(arguments: list[str]) -> int:
    """Writes the page to the file named, or to standard output."""
    if arguments:
        write_whole(Path(arguments[0]), markdown())
    else:
        sys.stdout.write(markdown())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

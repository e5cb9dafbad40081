"""docs/install-on-a-pole.md: keys, commands and messages on it exist."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from bikeped.config.build import framing
from bikeped.config.load import load_config
from bikeped.config.schema import Config
from bikeped.errors import GeometryError
from bikeped.faults import Fault
from bikeped.feedback.light import NOT_REFRESHED
from bikeped.pipeline.fault_monitor import FaultMonitor, Limits

PAGE = (Path(__file__).parents[2] / "docs" / "install-on-a-pole.md").read_text()
KEYS = sorted(
    set(re.findall(r"`((?:camera|detection|feedback|mqtt|audit)(?:\.[a-z]\w*)+)(?:: \w+)?`", PAGE))
)
COMMANDS = {
    "align",
    "run",
    "replay",
    "demo",
    "config",
    "doctor",
    "lamp",
    "calibrate",
    "conformance",
    "model",
}


@pytest.mark.parametrize("key", KEYS)
def test_every_key_exists(key: str) -> None:
    section = Config
    for part in key.split("."):
        section = {field.name: field.type for field in msgspec.structs.fields(section)}[part]


def test_the_examples_are_configurations() -> None:
    examples = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    configs = [msgspec.yaml.decode(example, type=Config) for example in examples]
    assert [config.feedback.light for config in configs] == ["gpio", "lamp"]


def test_only_commands_of_the_interface_are_used() -> None:
    pieces = re.findall(r"```sh\n(.*?)```|`([^`\n]+)`", PAGE, re.DOTALL)
    code = "\n".join(block + inline for block, inline in pieces)
    used = set(re.findall(r"(?:^|bin/|sudo )bikeped ([a-z]+)", code, re.MULTILINE))
    assert used
    assert used <= COMMANDS


def test_the_fault_table_has_the_texts_that_the_code_writes() -> None:
    with pytest.raises(GeometryError) as error:
        framing(load_config(None)).for_frame(64, 64)
    feed = SimpleNamespace(live=True, error=None, age_s=lambda _: math.inf)
    monitor = FaultMonitor(feed, Limits())  # type: ignore[arg-type]
    begin = monitor.faults(0.0)
    feed.age_s = lambda now_s: now_s
    monitor.processed(0.0)
    misfit = Fault("geometry", "camera.frame_size", str(error.value))
    faults = [*begin, *monitor.faults(9.0), misfit, NOT_REFRESHED]
    listed = [
        text.removesuffix("...").strip()
        for text in re.findall(r"^\| `([^`]+)` \|", PAGE, re.MULTILINE)
    ]
    for fault in faults:
        assert any(str(fault).startswith(text) for text in listed), fault

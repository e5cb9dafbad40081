"""Editing the text of a configuration: what was asked for changes, and not a character more."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.config.edit import replace_section, section_lines, set_values
from bikeped.config.load import parse_config, parse_decision
from bikeped.config.schema import DecisionConfig
from bikeped.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "after"),
    [
        (
            "camera: {calibration: a, height_m: 3}",
            "camera: {calibration: a, height_m: 4.0, cx: 7.5}",
        ),
        (
            "camera:\n    height_m:\n    fps: 30",
            "camera:\n    height_m: 4.0\n    fps: 30\n    cx: 7.5",
        ),
        ("a: 1\n", "a: 1\ncamera:\n  height_m: 4.0\n  cx: 7.5\n"),
        ("", "camera:\n  height_m: 4.0\n  cx: 7.5\n"),
        (
            "camera:\r\n  # hung high\r\n  height_m: '3'   # x\r\nweb: {}\r\n",
            "camera:\r\n  # hung high\r\n  height_m: 4.0   # x\r\n  cx: 7.5\r\nweb: {}\r\n",
        ),
        (
            "\ufeffcamera:\n  height_m: 3.12345678 # x\n# end\n",
            "\ufeffcamera:\n  height_m: 4.0        # x\n  cx: 7.5\n# end\n",
        ),
        (
            "camera:\n  cx: 1\n  height_m: 2 # tight\n",
            "camera:\n  cx: 7.5\n  height_m: 4.0 # tight\n",
        ),
    ],
)
def test_edits_keep_the_rest_to_the_character(text: str, after: str) -> None:
    assert set_values(text, {"camera": {"height_m": 4.0, "cx": 7.5}}, "c.yaml") == after


@pytest.mark.parametrize("text", ["camera: null\n", "camera:\n", "{web: {}}\n", "[1]\n"])
def test_what_cannot_be_edited_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"c\.yaml"):
        set_values(text, {"camera": {"height_m": 4.0}}, "c.yaml")


BLOCKS = ("camera:\n  radius_px: 1750\n  fov_deg: 197.9{}\n", "web: {enabled: false}\n", "# note\n")


@settings(max_examples=60, deadline=None)
@given(
    order=st.permutations(BLOCKS),
    extra=st.sampled_from(
        ["", "  # wide", "\n  # hung by Ann\n  height_m: 3.3 # ft?", "\n  cy: 5"]
    ),
    values=st.dictionaries(
        st.sampled_from(["height_m", "pitch_deg", "cx", "cy", "radius_px"]),
        st.floats(0.5, 89),
        min_size=1,
    ),
)
def test_an_edit_changes_exactly_what_it_says(order, extra, values) -> None:
    text = "".join(block.format(extra) if block.startswith("camera") else block for block in order)
    values = {key: round(value, 2) for key, value in values.items()}
    old = parse_config(text, "x", Path()).config
    new = parse_config(set_values(text, {"camera": values}, "x"), "x", Path()).config
    assert new == msgspec.structs.replace(old, camera=msgspec.structs.replace(old.camera, **values))


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\ndecision: {rule: ttc}  # inline\nb: 2 # kept\n",
        "a: 1\ndecision:\nb: 2\n",
        "decision:\n  rule: ttc",
        "decision:\n  rule: >-\n    ttc\n# kept\na: 1\n",
        "---\na: 1\n'decision':\n    rule: ttc\n\n  # inner\n# kept\nb: [1,\n  2]\n",
        "  a: 1\n  decision:\n    rule: ttc\n  b: 2\n",
        "a: 1\r\ndecision:\r\n  rule: ttc # x\r\n# kept\r\nb: 2\r\n",
        "a: 1  # no section at all",
        "",
        "\ufeffa: 1\ndecision:\n  rule: ttc\n",
    ],
)
def test_any_way_to_write_the_section_is_replaced_alone(text):
    other = DecisionConfig(rule="naive", d_max_m=12.5)
    values = msgspec.to_builtins(other)
    new = replace_section(text, "decision", values, "x", "note")
    data, was = yaml.safe_load(new), yaml.safe_load(text) or {}
    assert parse_decision(yaml.safe_dump({"decision": data.pop("decision")}), "x") == other
    was.pop("decision", None)
    assert data == was
    assert ("# kept" in text) == ("# kept" in new)
    assert ("\r\n" in text) == ("\r\n" in new)
    assert new.replace("\r\n", "").count("\r") == 0
    again = replace_section(new, "decision", values, "x", "note")
    assert again == new


#: Ways to write values that a YAML library is tempted to write anew.
ODD = """\
# top
---
{before}  # not the camera's
camera:   # head
   cx:    1
   fov_deg:   197.90   # a zero more
   calibration: 'a: b'

   # the board's
   source: "/dev/video0"
   radius_px: 01750
   fps: 3_0
   pad_size: ~
   crop_size: null
   projection:
   k1: 1.0e-3
   fourcc: MJPG  # {long}

# web
web:
  host:   127.0.0.1
"""


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("before", ["web2: [1,\n  2]\n", "a: >-\n  words\n\n  more\n", ""])
def test_a_line_of_another_key_is_not_set_anew(newline: str, before: str) -> None:
    text = ODD.format(before=before, long="x" * 300).replace("\n", newline)
    changed = set_values(text, {"camera": {"cx": 7.5, "height_m": 0.00001}}, "c.yaml")
    assert changed.replace("   cx: 7.5", "   cx:    1") == text.replace(
        "   fourcc: MJPG  # " + "x" * 300,
        "   fourcc: MJPG  # " + "x" * 300 + newline + "   height_m: 0.00001",
    )


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (1e-05, "0.00001"),
        (24.8, "24.8"),
        (4.0, "4.0"),
        (True, "true"),
        (None, "null"),
        (3, "3"),
        ("ttc", "ttc"),
        ("off", '"off"'),
        ("a: b # c", '"a: b # c"'),
        ("", '""'),
        ("010", '"010"'),
        (["a", "b"], '["a", "b"]'),
    ],
)
def test_a_value_is_written_so_that_it_is_read_as_itself(value: object, written: str) -> None:
    assert section_lines("a", {"b": value}) == ["a:", f"  b: {written}"]
    text = set_values("a:\n  b: 1  # why\n", {"a": {"b": value}}, "c.yaml")
    found = yaml.safe_load(text)["a"]["b"]
    assert found == value
    assert "# why" in text


@pytest.mark.parametrize(
    "text",
    [
        "camera: &a {cx: 1}\nb: *a\n",
        "camera:\n  cx: 1\n  cx: 2\n",
        "camera:\n  cx: [\n",
        "? [camera]\n: {cx: 1}\n",
        "camera: !!python/none {cx: 1}\n",
        "camera: 3\n",
    ],
)
def test_what_is_not_a_plain_configuration_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^c\.yaml: ") as caught:
        set_values(text, {"camera": {"cx": 4.0}}, "c.yaml")
    assert "\n" not in str(caught.value)

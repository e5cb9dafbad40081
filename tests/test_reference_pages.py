"""The pages made from the code are current: otherwise `python tests/reference_pages.py`."""

import re

import pytest
import reference_pages

from bikeped.config.validate import known_keys


@pytest.mark.parametrize("path", reference_pages.pages(), ids=lambda path: path.name)
def test_the_committed_page_is_current(path):
    assert path.read_text(encoding="utf-8") == reference_pages.pages()[path], (
        "run: python tests/reference_pages.py"
    )


def test_no_other_schema_is_published():
    published = set((reference_pages.DOCS / "messages").glob("*.schema.json"))
    assert published <= reference_pages.pages().keys()


def rows():
    """Cells of every table row that describes a key."""
    page = reference_pages.configuration_page()
    lines = [line for line in page.splitlines() if line.startswith("| `")]
    return [re.split(r"(?<!\\) \| ", line[2:-2]) for line in lines]


def test_every_key_stands_there_once_with_type_default_and_meaning():
    assert [cells[0].strip("`") for cells in rows()] == list(in_page_order())
    for cells in rows():
        assert len(cells) == 4, cells
        assert all(cell.strip() for cell in cells), cells


def in_page_order():
    """Keys with a nested section's after those of the section that holds it."""
    keys = list(known_keys())
    sections = list(dict.fromkeys(key.rpartition(".")[0] for key in keys))
    return [key for section in sections for key in keys if key.rpartition(".")[0] == section]


def test_some_rows():
    table = {cells[0].strip("`"): cells[1:] for cells in rows()}
    assert table["decision.d_max_m"][:2] == ["number above 0 to 100", "`24.8`"]
    assert table["mqtt.port"][:2] == ["whole number 1 to 65535", "`1883`"]
    assert table["feedback.gpio.red"][0] == "text or whole number 0 to 4095 or `null`"
    assert table["latency.compensation"][1] == '`"off"`'
    assert table["detection.providers"][1] == "`[tensorrt, cuda, cpu]`"

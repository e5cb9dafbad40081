"""The page of all keys is made from the descriptions, and is current."""

import re
from pathlib import Path

from bikeped.config.docs import main, markdown
from bikeped.config.validate import known_keys

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


def rows():
    """Cells of every table row that describes a key."""
    lines = [line for line in markdown().splitlines() if line.startswith("| `")]
    return [re.split(r"(?<!\\) \| ", line[2:-2]) for line in lines]


def test_the_committed_page_is_current():
    assert PAGE.read_text(encoding="utf-8") == markdown(), (
        "run: python -m bikeped.config.docs docs/configuration.md"
    )


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


def test_the_command_writes_the_page(tmp_path, capsys):
    assert main([str(tmp_path / "page.md")]) == 0
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == markdown()
    assert main([]) == 0
    assert capsys.readouterr().out == markdown()

"""The report: valid, escaped, relative, and its verdict is that of the gates."""

from html.parser import HTMLParser
from pathlib import Path

import pytest

from bikeped.errors import BikepedError
from bikeped.lab.experiments.report import write_index
from bikeped.lab.result_tables import ExperimentResult, ResultTable

EVIL = '<script>alert("x")</script> & $1$'
VOID = {"meta", "img", "br", "link", "hr"}


class Checker(HTMLParser):
    """Fails on tags that are not closed in order; collects tags, links and text."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.links, self.ids, self.text = [], [], [], [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for key, value in attrs:
            if key in ("href", "src"):
                self.links.append(value)
            if key == "id":
                self.ids.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data


def page(folder, sensitivity=0.95, figures=(), name=EVIL):
    row = {
        "sensitivity": sensitivity,
        "specificity": 0.95,
        "mean_warning_budget_s": 3.0,
        "by_scenario": {name: {"sensitivity": 0.5, "min_warning_budget_s": 0.2}},
    }
    compare = ExperimentResult(
        "compare",
        {"scenarios": 24, "configurations": {"selected": row}},
        (
            ResultTable(
                "compare", f"A {EVIL}", ("what", "much"), [(EVIL, 1.5), ("b", None), ("c", 2.0)]
            ),
        ),
    )
    path = write_index(folder, [compare], list(figures), {"suite_hash": "abc", EVIL: EVIL})
    checker = Checker()
    text = path.read_text(encoding="utf-8")
    checker.feed(text)
    checker.close()
    assert checker.open == []
    return text, checker


def test_names_with_markup_are_escaped(tmp_path):
    text, checker = page(tmp_path)
    assert "script" not in checker.tags
    assert "<script" not in text.lower()
    assert EVIL in checker.text


def test_the_verdict_is_that_of_the_gates(tmp_path):
    assert "passes all gates" in page(tmp_path)[1].text
    failing = page(tmp_path, sensitivity=0.8)[1].text
    assert "fails: sensitivity" in failing
    assert "may not be promoted" in failing
    assert "fails: sensitivity" in page(tmp_path, sensitivity=None)[1].text


def test_links_are_relative_and_lead_somewhere(tmp_path):
    folder = tmp_path / "figures"
    folder.mkdir()
    figures = [folder / "compare.png", folder / "compare.pdf", folder / "a b#.png"]
    for figure in figures:
        figure.write_bytes(b"x")
    (tmp_path / "compare.csv").write_text("")
    _, checker = page(tmp_path, figures=figures)
    outside = [x for x in checker.links if not x.startswith("#")]
    assert set(outside) == {
        "figures/compare.png",
        "figures/compare.pdf",
        "figures/a%20b%23.png",
        "compare.csv",
    }
    assert all(x[1:] in checker.ids for x in checker.links if x.startswith("#"))
    assert len(checker.ids) == len(set(checker.ids))


def test_fractions_of_a_column_have_equally_many_decimals(tmp_path):
    text, _ = page(tmp_path)
    assert "<td class=n>1.5</td>" in text
    assert "<td class=n>2.0</td>" in text
    assert "<td class=n>–</td>" in text


def test_nothing_of_this_machine_is_in_the_page(tmp_path):
    figure = tmp_path / "x.png"
    figure.write_bytes(b"")
    assert str(tmp_path) not in page(tmp_path, figures=[figure])[0]


def test_without_experiments_there_is_a_page_and_no_verdict(tmp_path):
    path = write_index(tmp_path, [], [], {})
    text = path.read_text(encoding="utf-8")
    assert "no verdict" in text
    assert "Low light or rain" in text


def test_a_folder_that_is_not_there_is_named():
    with pytest.raises(BikepedError, match="cannot be written"):
        write_index(Path("not") / "there", [], [], {})


def test_the_configuration_in_force_is_judged_when_it_was_run(tmp_path):
    figures = {"sensitivity": 0.5, "specificity": 0.95, "mean_warning_budget_s": 3.0}
    row = {"scenario": "Here", "danger_frames": 5, **figures}
    run = ExperimentResult("run", {"metrics": figures, "scenarios": [row]})
    better = {"selected": {**figures, "sensitivity": 0.99}}
    compare = ExperimentResult("compare", {"configurations": better})
    text = write_index(tmp_path, [run, compare], [], {}).read_text(encoding="utf-8")
    assert "may not be promoted" in text
    assert "not one alert" not in text  # how many alerts there were in danger is not known here

"""Figures: drawn from the documented data, the same bytes twice, absent experiments skipped."""

import re
import sys

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.config.schema import DecisionConfig
from bikeped.errors import BikepedError
from bikeped.lab.cli.conformance import command as conformance
from bikeped.lab.experiments.report import FIGURES, draw_all
from bikeped.lab.experiments.scenario_figures import draw_plan, draw_strip, spans
from bikeped.lab.plotting import FigureSheet, file_stem
from bikeped.lab.scenarios.scenario import parse_scenario
from bikeped.lab.simulation.suite import Suite

MARKUP = """
name: "Fast & <script>alert(1)</script> $x^2$ ../up"
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -8.0], [6.0, 5.0, 0.0]]}
  - {id: 2, kind: cyclist, path: [[0.5, -8.0, -2.0], [6.0, 25.0, -2.0]]}
"""
NOBODY = """
name: Empty
hazard: safe
agents:
  - {id: 1, kind: truck, path: [[0.0, -40.0, 0.0], [3.0, 40.0, 0.0]]}
"""


def interval(mean):
    return {"mean": mean, "low": mean - 0.02, "high": mean + 0.01}


SERIES = {
    "sensitivity": [0.95, None, 0.7],
    "specificity": [0.9, 0.92, 0.95],
    "sev_fn": [0.05, 0.1, 0.2],
    "mean_warning_budget_s": [3.0, 2.5, None],
}
LOSS = {
    key: {k: [interval(0.9)[k], interval(0.8)[k], None] for k in ("mean", "low", "high")}
    for key in ("sensitivity", "mean_warning_budget_s")
}
FIGURES_OF_ONE = {"sensitivity": 0.93, "specificity": 0.92, "sev_fn": 0.07}
DATA = {
    "compare": {
        "configurations": {"selected": FIGURES_OF_ONE, "odd_$one$": FIGURES_OF_ONE},
        "without_localisation_error": {"selected": FIGURES_OF_ONE},
    },
    "errors": {
        "table": [
            {"kind": k, "distance_m": d, "bearing_deg": b, "error_m": 0.1 * d}
            for k in ("pedestrian", "car")
            for b in (0, 60)
            for d in (3, 10)
        ],
        "map": {
            "car": {
                "x_m": [1.0, 10.0, 20.0],
                "y_m": [-10.0, 0.0, 10.0],
                "error_m": [[None, 0.2, 0.4], [0.6, 1.2, 2.5], [0.5, 0.6, 0.7]],
            }
        },
    },
    "truth": {
        "rows": [
            {"parameter": "cpa_radius_m", "value": 3.0, "default": False, **FIGURES_OF_ONE},
            {"parameter": "ttc_bound_s", "value": None, "default": True, **FIGURES_OF_ONE},
        ]
    },
    "montecarlo": {
        "rows": [
            {
                "loss": loss,
                "recall": "size",
                "configuration": "selected",
                "metrics": {"sensitivity": interval(0.9)},
            }
            for loss in ("independent", "burst")
        ]
    },
    "latency": {"delay_ms": [0, 100, 200], "none": SERIES, "first": SERIES, "second": SERIES},
    "latency_loss": {"delay_ms": [0, 100, 200], "predictors": {"none": LOSS}},
    "budgets": {
        "rows": [
            {"scenario": "A $", "mean": 3.0, "min": 2.0, "onsets": [2.0, 4.0], "class": "below"},
            {"scenario": "B", "mean": None, "min": None, "onsets": [], "class": "below"},
        ]
    },
    "optimize": {"trace": [[1, 50.0], [10, 0.8], [20, 0.6]]},
    "deployment": {
        "rows": [
            {
                "width_ft": w,
                "cameras": c,
                "height_m": 5.5,
                "pitch_deg": 0,
                "sensitivity": interval(0.8),
            }
            for w in (30, 60)
            for c in (1, 2)
        ]
    },
    "placement": {
        "height_m": [1.5, 2.0],
        "pitch_deg": [-0.0, -10.0],
        "sensitivity": [[0.9, None], [0.7, 0.8]],
    },
    "braking": {"rows": [{"profile": "bicycle", "metrics": FIGURES_OF_ONE}]},
}


@pytest.fixture(scope="module")
def suite():
    return Suite.load([parse_scenario(t, "x") for t in (MARKUP, NOBODY)], load_config())


@pytest.fixture(scope="module")
def drawn(suite, tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures") / "made"
    return draw_all(DATA, suite, folder)


def test_every_figure_is_drawn_as_png_and_pdf(drawn):
    assert {p.stem for p in drawn} == set(FIGURES)
    assert {p.suffix for p in drawn} == {".png", ".pdf"}
    for path in drawn:
        head = path.read_bytes()[:5]
        assert head == (b"\x89PNG\r" if path.suffix == ".png" else b"%PDF-")


def test_the_same_data_give_the_same_bytes_and_no_dates(suite, drawn, tmp_path):
    part = {k: DATA[k] for k in ("compare", "optimize")}
    for path in draw_all(part, suite, tmp_path):
        first = next(p for p in drawn if p.name == path.name)
        assert path.read_bytes() == first.read_bytes()
        assert not re.search(rb"CreationDate|ModDate|Matplotlib v", path.read_bytes())


def test_absent_and_empty_experiments_are_skipped(suite, tmp_path):
    assert draw_all({}, suite, tmp_path) == []
    assert draw_all({"latency": {}, "errors": {"map": {}}}, suite, tmp_path) == []
    one = draw_all({"latency_loss": DATA["latency_loss"]}, suite, tmp_path)
    assert {p.stem for p in one} == {"loss_latency"}


def test_strip_and_plan_of_any_scenario(suite, tmp_path):
    for index in range(len(suite.scenarios)):
        files = draw_strip(suite, DecisionConfig(), index, tmp_path)
        files += draw_plan(suite, DecisionConfig(), index, tmp_path)
        assert all(p.parent == tmp_path and p.stat().st_size > 1000 for p in files)
    assert len(list(tmp_path.iterdir())) == 8


def test_a_name_cannot_leave_the_folder():
    assert file_stem("../../etc/pass wd") == "etc-pass-wd"
    assert file_stem("///") == "scenario"
    assert file_stem("\u00fc") == "scenario"


def test_spans():
    state = np.array([3, 3, 0, 2, 3, 3], np.int8)
    time_s = np.arange(6) / 30
    found = spans(state == 3, time_s)
    assert np.allclose(found, [(0, 2 / 30), (4 / 30, 6 / 30)])


def test_without_matplotlib_the_remedy_is_named(suite, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(BikepedError, match=r"pip install 'bikeped\[sim\]'"):
        draw_all(DATA, suite, tmp_path)
    with pytest.raises(BikepedError, match="matplotlib"):
        FigureSheet("a", "b")


def test_drawing_leaves_matplotlib_s_settings_alone(suite, tmp_path):
    import matplotlib as mpl

    before = dict(mpl.rcParams)
    draw_all({"optimize": DATA["optimize"]}, suite, tmp_path)
    assert dict(mpl.rcParams) == before


def test_a_folder_that_cannot_be_made_is_named(suite, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BikepedError, match="cannot be made"):
        draw_all(DATA, suite, tmp_path / "file" / "sub")


def test_plot_draws_one_scenario_and_names_an_unknown_one(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "x.yaml").write_text(MARKUP)
    (tmp_path / "s" / "y.yaml").write_text(NOBODY)
    arguments = ["plot", "--scenarios", str(tmp_path / "s"), "--out", str(tmp_path / "o")]
    conformance.main([*arguments, "--scenario", "Empty"], standalone_mode=False)
    assert sorted(p.name for p in (tmp_path / "o").iterdir()) == [
        "empty-plan.pdf",
        "empty-plan.png",
        "empty-strip.pdf",
        "empty-strip.png",
    ]
    with pytest.raises(BikepedError, match="did you mean 'Empty'"):
        conformance.main([*arguments, "--scenario", "Empt"], standalone_mode=False)

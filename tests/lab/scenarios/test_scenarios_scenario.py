"""Scenario files: read, refused with one line, written back; agents along their paths."""

import math
import re

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import ScenarioError
from bikeped.lab.scenarios.scenario import (
    HAZARDS,
    SIZES_M,
    Agent,
    Scenario,
    dump_scenario,
    load_scenario,
    load_scenarios,
    parse_scenario,
)

PARALLEL = """\
name: Parallel Paths
hazard: standard
expected: warning
vehicle: bicycle
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -6.0], [7.5, 5.0, 9.0]]}
  - {id: 2, kind: cyclist,    path: [[2.0, 8.0, -6.0], [8.0, 8.0, 6.0]]}
"""


def refusal(text):
    with pytest.raises(ScenarioError) as refused:
        parse_scenario(text, "a.yaml")
    line = str(refused.value)
    assert line.startswith("a.yaml: ")
    assert "\n" not in line
    assert len(line) < 300
    return line


def one(path="[[0, 0, 0], [1, 1, 0]]", kind="cyclist", extra="", top=""):
    return f"name: A\n{top}agents:\n  - {{id: 7, kind: {kind}, path: {path}{extra}}}\n"


def test_the_example_of_the_interface():
    scenario = parse_scenario(PARALLEL, "a.yaml")
    assert (scenario.name, scenario.hazard, scenario.expected, scenario.vehicle) == (
        "Parallel Paths", "standard", "warning", "bicycle",
    )  # fmt: skip
    pedestrian, cyclist = scenario.agents
    assert (pedestrian.id, pedestrian.kind, pedestrian.size_m) == (1, "pedestrian", (0.3, 0.5, 1.7))
    assert (cyclist.start_s, cyclist.end_s) == (2.0, 8.0)
    assert scenario.duration_s == 8.5
    assert scenario.source == "a.yaml"


def test_what_may_be_left_out():
    scenario = parse_scenario(one(), "a.yaml")
    assert (scenario.hazard, scenario.expected, scenario.vehicle, scenario.story) == (
        "standard", "warning", "bicycle", "",
    )  # fmt: skip
    child = parse_scenario(one(kind="pedestrian", extra=", size: {height: 1.1}"), "a.yaml")
    assert child.agents[0].size_m == (0.3, 0.5, 1.1)
    told = parse_scenario(one(top="story: |\n  Two\n  lines\n"), "a.yaml")
    assert told.story == "Two lines"


# ---- refused


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (one("[[0, 0, 0], [0, 1, 0]]"), "agent 7: path[1]: time 0 s is not after 0 s; sort"),
        (one("[[0, 0, 0], [2, 1, 0], [1, 2, 0]]"), "agent 7: path[2]: time 1 s is not after 2 s"),
        (one("[[0, 0, 0]]"), "agent 7: path: needs at least two waypoints"),
        (one("[]"), "agent 7: path: needs at least two waypoints"),
        (one("7"), "agent 7: path: needs at least two waypoints"),
        (one("[[0, 0], [1, 1]]"), "agent 7: path[0]: expected [t, x, y]"),
        (one("[[0, 0, 0], [1, .nan, 0]]"), "agent 7: path[1]: nan is not a finite number"),
        (one("[[0, 0, 0], [.inf, 0, 0]]"), "agent 7: path[1]: inf is not a finite number"),
        (one("[[0, 0, 0], [1, x, 0]]"), "agent 7: path[1]: 'x' is not a number"),
        (one("[[0, 0, 0], [1, true, 0]]"), "agent 7: path[1]: True is not a number"),
        (one("[[0, 0, 0], [1, 0x" + "f" * 5000 + ", 0]]"), "a huge number is not a finite"),
        (one("[[0, 0, 0], [1, 1e-3, 0]]"), "'1e-3' is not a number"),
        (one("[[-1, 0, 0], [1, 0, 0]]"), "agent 7: path: times must lie in 0 to 3600 s"),
        (one("[[0, 0, 0], [3601, 0, 0]]"), "agent 7: path: times must lie in 0 to 3600 s"),
        (one("[[0, 0, 0], [1, 10001, 0]]"), "agent 7: path: a position is over 10 km away"),
        (one(kind="cylist"), "agent 7: kind: 'cylist' is not one of pedestrian, cyclist, car"),
        (one(kind="[" + "a, " * 400 + "]"), "agent 7: kind: ['a', 'a'"),
        (one(kind="null"), "agent 7: kind: None is not one of"),
        (one(extra=", size: {height: 31}"), "agent 7: size.height: 31 is not 0.05 to 30 m"),
        (one(extra=", size: {height: 0}"), "agent 7: size.height: 0 is not 0.05 to 30 m"),
        (one(extra=", size: {heigt: 1}"), "agent 7: size.heigt: unknown key; did you mean height?"),
        (one(extra=", size: 3"), "agent 7: size: expected keys and values"),
        (one(top="duration_s: 0.5\n"), "duration_s: 0.5 s is not from the last waypoint's 1 s"),
        (one(top="duration_s: long\n"), "duration_s: 'long' is not a number"),
        (one(extra=", hidden: 3"), "agent 7: hidden: expected a list of [from, until]"),
        (one(extra=", hidden: [3]"), "agent 7: hidden[0]: expected [from, until]"),
        (one(extra=", hidden: [[2, 1]]"), "agent 7: hidden[0]: 1 s is not after 2 s"),
        (one(extra=", hidden: [[0, x]]"), "agent 7: hidden[0]: 'x' is not a number"),
        (one(extra=", pth: 3"), "agent 7: pth: unknown key; did you mean path?"),
        (one(extra=", path: [[0, 0, 0], [1, 0, 0]]"), "line 3: is not YAML (path is given twice)"),
        (one(top="hazzard: safe\n"), "hazzard: unknown key; did you mean hazard?"),
        (one(top='"a\\nb": safe\n'), "unknown key; known are"),
        (one(top="hazard: dire\n"), "hazard: 'dire' is not one of safe, standard"),
        (one(top="expected: fine\n"), "expected: 'fine' is not one of idle, safe"),
        (one(top="vehicle: car\n"), "vehicle: 'car' is not one of bicycle, ebike"),
        (one(top="name: B\n"), "line 2: is not YAML (name is given twice)"),
        (PARALLEL.replace("id: 2", "id: 1"), "agent 1: id is used twice"),
        (PARALLEL.replace("id: 2", "id: -2"), "agents[1]: id: expected a whole number from 0"),
        (PARALLEL.replace("id: 2", "id: true"), "agents[1]: id: expected a whole number from 0"),
        (PARALLEL.replace("id: 2, ", ""), "agents[1]: id: expected a whole number from 0"),
        (PARALLEL.replace("name: Parallel Paths", "name: 3"), "name: expected a text"),
        (PARALLEL.replace("name: Parallel Paths", "name: ' '"), "name: expected a text"),
        ("name: A\nagents: []\n", "agents: expected a list of 1 to 1000 agents"),
        ("name: A\n", "agents: expected a list of 1 to 1000 agents"),
        ("name: A\nagents: [" + "1, " * 1001 + "]\n", "agents: expected a list of 1 to 1000"),
        ("name: A\nagents: [1]\n", "agents[0]: expected keys and values"),
        ("", "scenario: expected keys and values"),
        ("- a\n", "scenario: expected keys and values"),
        ("1: 2\n", "scenario: expected keys and values"),
        ("name: [\n", "line 2: is not YAML"),
        ("name: !!int ''\n", "is not a usable YAML value"),
        ('name: "\\ud800"\n', "a character that no text can hold"),
        ("a: &a [1]\nstory: [*a, *a]\n", "line 2: is not YAML (aliases are not allowed"),
        ("story: " + "[" * 300, "nested too deeply"),
    ],
    ids=lambda v: re.sub(r"\s+", " ", v)[-40:] if len(v) < 1000 else "long",
)
def test_bad_scenarios_get_one_line(text, part):
    assert part in refusal(text)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(st.one_of(st.text(max_size=40), st.text(alphabet="name:gts-[]{}, \n'\"1.0&*!", max_size=60)))
def test_any_text_is_refused_with_one_line(text):
    # None of these is a whole scenario, so each of them must be refused, and in words.
    refusal(text)


def test_bad_files(tmp_path):
    (tmp_path / "latin.yaml").write_bytes(b"name: \xe9")
    (tmp_path / "long.yaml").write_bytes(b"#" * 1_000_001)
    for name, part in (
        ("none.yaml", "cannot be read (No such file or directory)"),
        ("latin.yaml", "is not UTF-8 text"),
        ("long.yaml", "larger than 1 MB"),
    ):
        with pytest.raises(ScenarioError, match=re.escape(part)) as refused:
            load_scenario(tmp_path / name)
        assert str(refused.value).startswith(str(tmp_path / name))


def test_folders(tmp_path):
    with pytest.raises(ScenarioError, match="holds no scenario file"):
        load_scenarios(tmp_path)
    with pytest.raises(ScenarioError, match="is not a folder"):
        load_scenarios(tmp_path / "none")
    for file, name in (("b.yaml", "First"), ("c.yml", "Second"), ("a.yaml", "Third")):
        (tmp_path / file).write_text(PARALLEL.replace("Parallel Paths", name))
    (tmp_path / "readme.txt").write_text("not one")
    assert [s.name for s in load_scenarios(tmp_path)] == ["Third", "First", "Second"]
    (tmp_path / "d.yaml").write_text(PARALLEL.replace("Parallel Paths", "First"))
    with pytest.raises(ScenarioError, match=r"d\.yaml: name 'First' is taken by .*b\.yaml"):
        load_scenarios(tmp_path)


# ---- written back

number = st.floats(-1e4, 1e4, allow_subnormal=False)
texts = st.text(
    st.characters(exclude_categories=("Cs",), exclude_characters="\0"), min_size=1, max_size=20
).filter(lambda text: text.strip())


@st.composite
def scenarios(draw):
    agents = []
    for i in draw(st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=3, unique=True)):
        kind = draw(st.sampled_from(sorted(SIZES_M)))
        times = draw(st.lists(st.floats(0, 3600), min_size=2, max_size=4, unique=True))
        path = np.array([[t, draw(number), draw(number)] for t in sorted(times)])
        size = draw(st.one_of(st.just(SIZES_M[kind]), st.tuples(*[st.floats(0.05, 30)] * 3)))
        agents.append(Agent(i, kind, path, size))
    return Scenario(
        draw(texts).strip(),
        draw(st.sampled_from(HAZARDS)),
        draw(st.sampled_from(["idle", "safe", "warning", "alert"])),
        draw(st.sampled_from(["bicycle", "ebike"])),
        tuple(agents),
        " ".join(draw(texts).split()),
        "a.yaml",
    )


@settings(derandomize=True, deadline=None, max_examples=150)
@given(scenarios())
def test_what_is_written_is_read_back(scenario):
    text = dump_scenario(scenario)
    text.encode("utf-8")
    again = parse_scenario(text, "a.yaml")
    for name in ("name", "hazard", "expected", "vehicle", "story", "source"):
        assert getattr(again, name) == getattr(scenario, name)
    for mine, read in zip(scenario.agents, again.agents, strict=True):
        assert (mine.id, mine.kind, mine.size_m) == (read.id, read.kind, read.size_m)
        assert (mine.path == read.path).all()
    assert dump_scenario(again) == text


def test_awkward_names_and_small_numbers_are_read_back():
    path = np.array([[0.0, 1e-05, -1e-07], [1e-04, 5.0, 1e4]])
    for name in (
        "a: b # c",
        "tab\tbell\x07",
        "line\u2028and\u0085next\x7f",
        "\U0001f6b2 ü",
        '"\\"',
    ):
        scenario = Scenario(name, "safe", "idle", "ebike", (Agent(0, "car", path, SIZES_M["car"]),))
        again = parse_scenario(dump_scenario(scenario), "")
        assert again.name == name
        assert (again.agents[0].path == path).all()
    assert isinstance(yaml.safe_load(dump_scenario(scenario)), dict)


# ---- agents in time

BEND = Agent(
    1,
    "cyclist",
    np.array([[1.0, 0.0, 0.0], [2.0, 4.0, 0.0], [3.0, 4.0, 0.0], [5.0, 4.0, -6.0]]),
    SIZES_M["cyclist"],
)


def test_an_agent_exists_from_its_first_to_its_last_waypoint_and_moves_linearly():
    for t, expected in (
        (0.99, None), (1.0, (0, 0)), (1.25, (1, 0)), (2.0, (4, 0)), (2.7, (4, 0)), (4.0, (4, -3)),
        (5.0, (4, -6)), (5.01, None),
    ):  # fmt: skip
        found = BEND.at(t)
        if expected is None:
            assert found is None
        else:
            assert found[0] == pytest.approx(expected)
    xy, heading, present = BEND.sample(np.array([0.5, 1.5, 6.0]))
    assert present.tolist() == [False, True, False]
    assert np.isnan(xy[[0, 2]]).all()
    assert np.isnan(heading[[0, 2]]).all()


def test_heading_is_the_segments_direction_and_lasts_while_one_stands():
    assert BEND.at(1.5)[1] == 0.0
    assert BEND.at(2.5)[1] == 0.0  # stands, and keeps the direction it came in
    assert BEND.at(3.5)[1] == pytest.approx(-math.pi / 2)
    waits = Agent(1, "car", np.array([[0.0, 1, 1], [1.0, 1, 1], [2.0, 1, 5]]), SIZES_M["car"])
    assert waits.at(0.5)[1] == pytest.approx(math.pi / 2)  # the direction it will go
    stands = Agent(1, "car", np.array([[0.0, 1, 1], [1.0, 1, 1]]), SIZES_M["car"])
    assert stands.at(0.5)[1] == 0.0


def test_frames_are_at_thirtieths_up_to_half_a_second_after_the_last_waypoint():
    scenario = parse_scenario(PARALLEL, "a.yaml")
    times = scenario.frame_times()
    assert len(times) == 256  # 8.5 s: frames 0 to 255
    assert times[-1] == 255 / 30
    assert (times == np.arange(256) / 30).all()
    for last in (0.1, 1 / 3, 1.9, 7.7, 59.99):
        short = parse_scenario(one(f"[[0, 0, 0], [{last!r}, 1, 0]]"), "a.yaml")
        times = short.frame_times()
        assert times[-1] <= short.duration_s + 1e-6 < times[-1] + 1 / 30

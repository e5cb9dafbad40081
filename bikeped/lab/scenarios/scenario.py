"""Scenario files: paths of road users over time, in the world frame (x east, y north, metres)."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bikeped.config.strict_yaml import load_yaml
from bikeped.errors import ScenarioError
from bikeped.types import BoolArray, FloatArray

#: Length along the heading, width, height in metres (definitions, section 3).
SIZES_M: dict[str, tuple[float, float, float]] = {
    "pedestrian": (0.3, 0.5, 1.7),
    "cyclist": (1.8, 0.6, 1.7),
    "car": (4.5, 1.8, 1.5),
    "motorcycle": (2.2, 0.8, 1.4),
    "bus": (12.0, 2.5, 3.0),
    "truck": (7.0, 2.5, 2.8),
}
HAZARDS = ("safe", "standard", "high-speed", "accessibility", "multi-agent", "edge", "non-linear")
#: A scenario continues for this long after the last waypoint (definitions, section 4).
TAIL_S = 0.5
_SCENARIO_KEYS = {"name", "hazard", "expected", "vehicle", "agents", "story", "duration_s"}
_SIZE_KEYS = ("length", "width", "height")
_MAX_BYTES = 1_000_000
_MAX_DURATION_S = 3600.0
_MAX_COORDINATE_M = 10_000.0
_MAX_AGENTS = 1000


@dataclass(frozen=True)
class Agent:
    """One road user: `path` [n, 3] holds t (s), x, y (m); times strictly increase.

    In the spans `hidden` (from, until, s) something stands in the camera's way.
    """

    id: int
    kind: str
    path: FloatArray
    size_m: tuple[float, float, float]
    hidden: tuple[tuple[float, float], ...] = ()

    @property
    def start_s(self) -> float:
        return float(self.path[0, 0])

    @property
    def end_s(self) -> float:
        return float(self.path[-1, 0])

    def at(self, t: float) -> tuple[FloatArray, float] | None:
        """Position [2] and heading (radians from east) at `t`; None outside the agent's life."""
        xy, heading, present = self.sample(np.asarray([t]))
        return (xy[0], float(heading[0])) if present[0] else None

    def sample(self, t: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Positions [n, 2], headings [n] and presence [n] at times [n].

        The heading is the direction of the current path segment; where an agent stands still it
        keeps the last direction in which it moved (or the first it will move in). Absent: NaN.
        """
        times = self.path[:, 0]
        present = (t >= times[0] - 1e-9) & (t <= times[-1] + 1e-9)
        segment = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        t0, t1 = times[segment], times[segment + 1]
        part = np.clip((t - t0) / (t1 - t0), 0.0, 1.0)[:, None]
        xy = self.path[segment, 1:] * (1 - part) + self.path[segment + 1, 1:] * part
        # On a waypoint the heading is that of the segment that ends there (definitions, section 3).
        ending = np.searchsorted(times, t - 1e-9, side="right") - 1
        heading = self._headings()[np.clip(ending, 0, len(times) - 2)]
        return (np.where(present[:, None], xy, np.nan), np.where(present, heading, np.nan), present)

    def in_sight(self, t: FloatArray) -> BoolArray:
        """At which of the times [n] nothing hides the agent."""
        found: BoolArray = np.ones(len(t), np.bool_)
        for begin, end in self.hidden:
            found &= (t < begin - 1e-9) | (t > end + 1e-9)
        return found

    def _headings(self) -> FloatArray:
        step = np.diff(self.path[:, 1:], axis=0)
        moving = np.hypot(step[:, 0], step[:, 1]) > 1e-9
        heading = np.arctan2(step[:, 1], step[:, 0])
        if not moving.any():
            return np.zeros(len(step))
        source = np.maximum.accumulate(np.where(moving, np.arange(len(step)), -1))
        source[source < 0] = int(np.argmax(moving))
        out: FloatArray = heading[source]
        return out


@dataclass(frozen=True)
class Scenario:
    """One scripted encounter."""

    name: str
    hazard: str
    expected: str
    vehicle: str
    agents: tuple[Agent, ...]
    story: str = ""
    source: str = ""
    length_s: float | None = None

    @property
    def duration_s(self) -> float:
        """Time of the last frame's bound: `length_s`, or the last waypoint plus half a second."""
        last_s = max(agent.end_s for agent in self.agents)
        return last_s + TAIL_S if self.length_s is None else self.length_s

    def frame_times(self, fps: float = 30.0) -> FloatArray:
        """Times i / fps that are at most `duration_s` (tolerating the last bit)."""
        return np.arange(math.floor(self.duration_s * fps + 1e-6) + 1) / fps


def load_scenario(path: Path) -> Scenario:
    """Reads one scenario file; raises ScenarioError naming the file, the agent and the remedy."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ScenarioError(f"{path}: larger than 1 MB; a scenario is a short text")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: is not UTF-8 text; save it as UTF-8") from error
    return parse_scenario(text, str(path))


def load_scenarios(folder: Path) -> list[Scenario]:
    """All `*.yaml` and `*.yml` of a folder in file-name order, names unique.

    `street`, where there is no such folder, are the bundled scenes of an ordinary street.
    """
    if folder == Path("street") and not folder.exists():
        folder = street_folder()
    if not folder.is_dir():
        raise ScenarioError(f"{folder}: is not a folder of scenario files; check --scenarios")
    files = sorted(p for p in folder.iterdir() if p.suffix in {".yaml", ".yml"})
    if not files:
        raise ScenarioError(f"{folder}: holds no scenario file (*.yaml); check --scenarios")
    scenarios = [load_scenario(path) for path in files]
    seen: dict[str, str] = {}
    for scenario in scenarios:
        if scenario.name in seen:
            raise ScenarioError(
                f"{scenario.source}: name {scenario.name!r} is taken by {seen[scenario.name]}; "
                "give each scenario its own name"
            )
        seen[scenario.name] = scenario.source
    return scenarios


def street_folder() -> Path:
    """Folder of the bundled scenes of an ordinary street."""
    return Path(__file__).parent / "street"


def bundled_folder() -> Path:
    """Folder of the 24 scenarios that come with bikeped."""
    return Path(__file__).parent / "bundled"


def parse_scenario(text: str, source: str) -> Scenario:
    """A scenario from YAML text; `source` names it in errors."""
    at = f"{source}: "  # an error begins with the file, then the agent and the key
    try:
        data = load_yaml(text)
    except ValueError as error:
        raise ScenarioError(f"{at}{error}; correct it there") from error
    top = _mapping(data, f"{at}scenario")
    _check_keys(top, _SCENARIO_KEYS, at)
    name = top.get("name")
    if not isinstance(name, str) or not name.strip():
        raise ScenarioError(f"{at}name: expected a text; write name: My Scenario")
    agents_data = top.get("agents")
    if not isinstance(agents_data, list) or not 1 <= len(agents_data) <= _MAX_AGENTS:
        raise ScenarioError(f"{at}agents: expected a list of 1 to {_MAX_AGENTS} agents")
    agents = tuple(_agent(item, at, i) for i, item in enumerate(agents_data))
    ids = [agent.id for agent in agents]
    twice = next((i for i in ids if ids.count(i) > 1), None)
    if twice is not None:
        raise ScenarioError(f"{at}agent {twice}: id is used twice; give each its own")
    states = ("idle", "safe", "warning", "alert")
    return Scenario(
        name=name.strip(),
        hazard=_choice(top.get("hazard", "standard"), HAZARDS, f"{at}hazard"),
        expected=_choice(top.get("expected", "warning"), states, f"{at}expected"),
        vehicle=_choice(top.get("vehicle", "bicycle"), ("bicycle", "ebike"), f"{at}vehicle"),
        agents=agents,
        story=" ".join(str(top.get("story", "")).split()),
        source=source,
        length_s=_length_s(top.get("duration_s"), agents, at),
    )


def _length_s(value: object, agents: Sequence[Agent], at: str) -> float | None:
    if value is None:
        return None
    length_s, last_s = _number(value, f"{at}duration_s"), max(agent.end_s for agent in agents)
    if not last_s <= length_s <= _MAX_DURATION_S:
        raise ScenarioError(
            f"{at}duration_s: {length_s:g} s is not from the last waypoint's {last_s:g} s to "
            f"{_MAX_DURATION_S:g} s"
        )
    return length_s


def dump_scenario(scenario: Scenario) -> str:
    """YAML text that `parse_scenario` reads back to the same scenario."""
    lines = [
        f"name: {_quoted(scenario.name)}",
        f"hazard: {scenario.hazard}",
        f"expected: {scenario.expected}",
        f"vehicle: {scenario.vehicle}",
    ]
    if scenario.story:
        lines.append(f"story: {_quoted(scenario.story)}")
    if scenario.length_s is not None:
        lines.append(f"duration_s: {_yaml_number(scenario.length_s)}")
    lines.append("agents:")
    for agent in scenario.agents:
        path = ", ".join("[" + ", ".join(map(_yaml_number, p)) + "]" for p in agent.path)
        size = ""
        if agent.size_m != SIZES_M[agent.kind]:
            length, width, height = map(_yaml_number, agent.size_m)
            size = f", size: {{length: {length}, width: {width}, height: {height}}}"
        spans = ", ".join("[" + ", ".join(map(_yaml_number, span)) + "]" for span in agent.hidden)
        hidden = f", hidden: [{spans}]" if spans else ""
        lines.append(f"  - {{id: {agent.id}, kind: {agent.kind}{size}{hidden}, path: [{path}]}}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """A quoted YAML text on one line."""
    dumped: str = yaml.safe_dump(text, default_style='"', allow_unicode=True, width=math.inf)
    return dumped.strip()


def _yaml_number(number: float) -> str:
    """Decimal text that YAML reads as the same number; it reads 1e-05 without a dot as a text."""
    text = repr(float(number))
    return text if "." in text else text.replace("e", ".0e")


def _short_repr(value: object) -> str:
    """A value in an error message: one line, at most 60 characters."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # a whole number of thousands of digits
        return "a huge number"
    return text if len(text) <= 60 else text[:57] + "..."


def _mapping(data: object, at: str) -> Mapping[str, Any]:
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise ScenarioError(f"{at}: expected keys and values, see the documentation")
    return data


def _check_keys(data: Mapping[str, Any], known: set[str], at: str) -> None:
    for key in data:
        if key not in known:
            near = difflib.get_close_matches(key, sorted(known), 1)
            remedy = f"did you mean {near[0]}?" if near else f"known are {', '.join(sorted(known))}"
            raise ScenarioError(f"{at}{_short_repr(key)[1:-1]}: unknown key; {remedy}")


def _choice(value: object, allowed: tuple[str, ...], at: str) -> str:
    text = value.lower() if isinstance(value, str) else value
    if text not in allowed:
        raise ScenarioError(f"{at}: {_short_repr(value)} is not one of {', '.join(allowed)}")
    return str(text)


def _agent(item: object, file: str, index: int) -> Agent:
    data = _mapping(item, f"{file}agents[{index}]")
    number = data.get("id")
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < 2**31:
        raise ScenarioError(f"{file}agents[{index}]: id: expected a whole number from 0")
    at = f"{file}agent {number}: "
    _check_keys(data, {"id", "kind", "path", "size", "note", "hidden"}, at)
    kind = _choice(data.get("kind"), tuple(SIZES_M), f"{at}kind")
    path = _path(data.get("path"), f"{at}path")
    size = _size(data.get("size"), kind, f"{at}size")
    return Agent(number, kind, path, size, _hidden(data.get("hidden", []), f"{at}hidden"))


def _hidden(spans: object, at: str) -> tuple[tuple[float, float], ...]:
    if not isinstance(spans, list):
        raise ScenarioError(f"{at}: expected a list of [from, until] in seconds")
    found = []
    for i, span in enumerate(spans):
        if not isinstance(span, list) or len(span) != 2:
            raise ScenarioError(f"{at}[{i}]: expected [from, until] in seconds")
        begin, end = (_number(value, f"{at}[{i}]") for value in span)
        if not begin < end:
            raise ScenarioError(f"{at}[{i}]: {end:g} s is not after {begin:g} s; swap them")
        found.append((begin, end))
    return tuple(found)


def _path(points: object, at: str) -> FloatArray:
    """Waypoints [n, 3]: t (s), x, y (m)."""
    if not isinstance(points, list) or len(points) < 2:
        raise ScenarioError(f"{at}: needs at least two waypoints [t, x, y]")
    rows = []
    for i, point in enumerate(points):
        if not isinstance(point, list) or len(point) != 3:
            raise ScenarioError(f"{at}[{i}]: expected [t, x, y]")
        rows.append([_number(v, f"{at}[{i}]") for v in point])
    path = np.asarray(rows, dtype=np.float64)
    step = np.diff(path[:, 0])
    if not (step > 0).all():
        bad = int(np.argmax(step <= 0)) + 1
        raise ScenarioError(
            f"{at}[{bad}]: time {path[bad, 0]:g} s is not after {path[bad - 1, 0]:g} s; sort the "
            "waypoints by time"
        )
    if path[0, 0] < 0 or path[-1, 0] > _MAX_DURATION_S:
        raise ScenarioError(f"{at}: times must lie in 0 to {_MAX_DURATION_S:g} s")
    if np.abs(path[:, 1:]).max() > _MAX_COORDINATE_M:
        raise ScenarioError(f"{at}: a position is over 10 km away; use metres")
    return path


def _size(value: object, kind: str, at: str) -> tuple[float, float, float]:
    """Length, width, height in metres: of `value`, missing ones those of the kind."""
    data = _mapping({} if value is None else value, at)
    _check_keys(data, set(_SIZE_KEYS), f"{at}.")
    parts = []
    for key, usual in zip(_SIZE_KEYS, SIZES_M[kind], strict=True):
        number = _number(data.get(key, usual), f"{at}.{key}")
        if not 0.05 <= number <= 30:
            raise ScenarioError(f"{at}.{key}: {number:g} is not 0.05 to 30 m")
        parts.append(number)
    return parts[0], parts[1], parts[2]


def _number(value: object, at: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ScenarioError(f"{at}: {_short_repr(value)} is not a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ScenarioError(f"{at}: {_short_repr(value)} is not a finite number")
    return number

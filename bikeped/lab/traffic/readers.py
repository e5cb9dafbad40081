"""Reads a folder of traffic: trajectories as CSV or SUMO's FCD XML, and a pole for each scene.

`SCENE.csv[.gz]` has the columns `time_s,id,kind,x_m,y_m` in the world frame; `SCENE.xml[.gz]` is
what `sumo --fcd-output` writes; `poles.json` says for each scene where the camera stands:
`{"SCENE": {"x_m": 0, "y_m": 0, "heading_deg": 90}}`, as `CameraPose`.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bikeped.errors import ScenarioError
from bikeped.files import read_regular
from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.types import FloatArray

COLUMNS = ("time_s", "id", "kind", "x_m", "y_m")
POLES = "poles.json"
_SUFFIXES = (".csv", ".csv.gz", ".xml", ".xml.gz")
_POLE_KEYS = ("x_m", "y_m", "heading_deg")
_MOST_BYTES, _MOST_TEXT = 200_000_000, 1_000_000_000
#: A scene's length times its road users, seconds: some gigabytes while it is evaluated.
_MOST_SECONDS = 2e6
#: Kinds by what the name of a SUMO vehicle type contains; any other vehicle is a car.
_SUMO_KINDS = {
    **dict.fromkeys(("bike", "bicycle", "cycl", "scooter"), "cyclist"),
    **dict.fromkeys(("motorc", "moped"), "motorcycle"),
    **dict.fromkeys(("ped", "person"), "pedestrian"),
    **dict.fromkeys(("bus", "coach"), "bus"),
    **dict.fromkeys(("truck", "trailer"), "truck"),
}
#: Heading of a recorded path: of the way from this long before to this long after, if that is as
#: long as this; who stands keeps the last heading, whatever the noise of the recording.
_HEADING_S, _HEADING_M = 0.5, 0.2

#: One position: time (s), id, kind, x, y (m), and where it stands in the file.
_Point = tuple[float, str, str, float, float]


@dataclass(frozen=True)
class RecordedAgent(Agent):
    """A road user whose path was recorded: positions carry noise, and many lie close together."""

    def _headings(self) -> FloatArray:
        t = self.path[:-1, 0]
        before, after = (
            np.stack([np.interp(t + shift, self.path[:, 0], self.path[:, i]) for i in (1, 2)], -1)
            for shift in (-_HEADING_S, _HEADING_S)
        )
        return _kept_headings(after - before)


def _kept_headings(way: FloatArray) -> FloatArray:
    """Directions [n] of the ways [n, 2]; of one too short to tell, that before (or the first)."""
    told = np.hypot(way[:, 0], way[:, 1]) >= _HEADING_M
    if not told.any():
        return np.zeros(len(way))
    source = np.maximum.accumulate(np.where(told, np.arange(len(way)), -1))
    source[source < 0] = int(np.argmax(told))
    return np.asarray(np.arctan2(way[:, 1], way[:, 0])[source])


@dataclass(frozen=True)
class TrafficScene:
    """One recording: its road users as a scenario's agents, and the pole that watches them."""

    scenario: Scenario
    pose: CameraPose


def read_traffic(folder: Path) -> tuple[TrafficScene, ...]:
    """The scenes of a folder in order of name; ScenarioError names file, place and remedy."""
    if not folder.is_dir():
        raise ScenarioError(f"{folder}: is not a folder of traffic; name one with {POLES}")
    files = {_scene(p): p for p in sorted(folder.iterdir()) if p.name.endswith(_SUFFIXES)}
    if not files:
        raise ScenarioError(f"{folder}: holds no SCENE.csv, .csv.gz, .xml or .xml.gz; check it")
    poles = _poles(folder / POLES)
    scenes = []
    for name, path in files.items():
        if name not in poles:
            raise ScenarioError(
                f"{folder / POLES}: {name}: is missing; add where the camera of that scene stands"
            )
        scenes.append(TrafficScene(read_scene(path), poles[name]))
    return tuple(scenes)


def read_scene(path: Path) -> Scenario:
    """The road users of one recording, from its first moment on."""
    rows = _xml_points(path) if ".xml" in path.suffixes else _csv_points(path)
    points: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    kinds: dict[str, str] = {}
    for t, who, kind, x, y in rows:
        if kinds.setdefault(who, kind) != kind:
            raise ScenarioError(f"{path}: id {who}: is {kinds[who]} and {kind}; give each one kind")
        points.setdefault((who, kind), []).append((t, x, y))
    first_s = min((t for found in points.values() for t, _, _ in found), default=0.0)
    agents = []
    for number, ((who, kind), found) in enumerate(points.items(), 1):
        track = np.asarray(sorted(found)) - [first_s, 0.0, 0.0]
        if (np.diff(track[:, 0]) <= 0).any():
            at = first_s + float(track[1:][np.diff(track[:, 0]) <= 0][0, 0])
            raise ScenarioError(f"{path}: id {who}: is in two places at {at:g} s; keep one")
        if len(track) > 1:  # who is seen once has no path
            agents.append(RecordedAgent(number, kind, track, SIZES_M[kind]))
    if not agents:
        raise ScenarioError(f"{path}: holds nobody with two positions; check the recording")
    scene = Scenario(_scene(path), "standard", "warning", "bicycle", tuple(agents), "", str(path))
    if scene.duration_s * len(agents) > _MOST_SECONDS:
        raise ScenarioError(
            f"{path}: {scene.duration_s:.0f} s of {len(agents)} road users are too much at once; "
            "cut it into shorter scenes"
        )
    return scene


def _scene(path: Path) -> str:
    return path.name.removesuffix(".gz").rpartition(".")[0]


def _text(path: Path) -> str:
    try:
        data = read_regular(path, _MOST_BYTES)
        if path.suffix == ".gz":
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
                data = file.read(_MOST_TEXT)
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: is not UTF-8 text; save it as UTF-8") from error
    except (OSError, EOFError, zlib.error) as error:
        why = getattr(error, "strerror", None) or "it is no whole gzip file"
        raise ScenarioError(f"{path}: cannot be read ({why}); check the file") from error


def _csv_points(path: Path) -> Iterator[_Point]:
    lines = csv.reader(io.StringIO(_text(path)))
    header = next(lines, [])
    if sorted(header) != sorted(COLUMNS):
        raise ScenarioError(f"{path}: line 1: expected the columns {','.join(COLUMNS)}")
    order = [header.index(name) for name in COLUMNS]
    for number, line in enumerate(lines, 2):
        if not line:
            continue
        at = f"{path}: line {number}"
        if len(line) != len(COLUMNS):
            raise ScenarioError(f"{at}: expected {len(COLUMNS)} values, found {len(line)}")
        t, who, kind, x, y = (line[i] for i in order)
        if kind not in SIZES_M:
            raise ScenarioError(f"{at}: kind: {kind[:30]!r} is not one of {', '.join(SIZES_M)}")
        yield _number(t, at, "time_s", 0.0), who, kind, _number(x, at, "x_m"), _number(y, at, "y_m")


def _xml_points(path: Path) -> Iterator[_Point]:
    try:
        root = ElementTree.fromstring(_text(path))
    except ElementTree.ParseError as error:
        raise ScenarioError(f"{path}: is not XML ({error}); write it with --fcd-output") from error
    if root.tag != "fcd-export":
        raise ScenarioError(f"{path}: <{root.tag}>: expected <fcd-export>, SUMO's --fcd-output")
    for step in root.iter("timestep"):
        t = _number(step.get("time"), f"{path}: timestep", "time", 0.0)
        for item in step:
            at = f"{path}: time {t:g} s: <{item.tag}>"
            who = item.get("id")
            if who is None:
                raise ScenarioError(f"{at}: id is missing; write it with --fcd-output")
            if item.tag == "person":
                kind = "pedestrian"
            else:
                words = item.get("type", "").lower()
                kind = next((k for word, k in _SUMO_KINDS.items() if word in words), "car")
            x, y = (_number(item.get(axis), at, axis) for axis in ("x", "y"))
            yield t, f"{item.tag} {who}", kind, x, y


def _poles(path: Path) -> Mapping[str, CameraPose]:
    try:
        data: Any = json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{path}: is not JSON ({error}); correct it") from error
    if not isinstance(data, dict):
        raise ScenarioError(f'{path}: expected {{"SCENE": {{"x_m": 0, "y_m": 0, ...}}}}')
    poles = {}
    for name, pole in data.items():
        if not isinstance(pole, dict) or sorted(pole) != sorted(_POLE_KEYS):
            raise ScenarioError(f"{path}: {name}: expected the keys {', '.join(_POLE_KEYS)}")
        poles[name] = CameraPose(*(_number(pole[k], f"{path}: {name}", k) for k in _POLE_KEYS))
    return poles


def _number(value: object, at: str, key: str, least: float = -1e6, most: float = 1e6) -> float:
    try:
        number = float(value) if isinstance(value, (str, int, float)) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not least <= number <= most:
        shown = str(value)[:30]
        raise ScenarioError(f"{at}: {key}: {shown!r} is no number from {least:g} to {most:g}")
    return number

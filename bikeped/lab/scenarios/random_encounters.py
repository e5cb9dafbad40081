"""Random encounters of cyclists and pedestrians as scenarios: the same for the same seed. Pure.

A meeting is drawn first, a place and a time, then who comes to it from where, how fast, and by how
much they miss one another. Many are harmless. They are made for the simulation's camera at (5, -13)
looking north, whose range is 25 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario
from bikeped.types import FloatArray

#: How often each course of the cyclist relative to the pedestrian's is drawn.
COURSES = {"crossing": 0.4, "same way": 0.2, "opposite": 0.2, "late turn": 0.2}
#: What the pedestrian does, and what the cyclist does at the end.
WALKS = {"walks": 0.6, "stands": 0.2, "stops": 0.1, "sets off": 0.1}
RIDES = {"rides on": 0.8, "stops": 0.12, "turns away": 0.08}
WALK_MPS = (0.5, 2.0)
RIDE_MPS = (2.0, 9.0)
PASS_M = 8.0  #: the cyclist aims at most so far beside the pedestrian, and nearer more often
_BEFORE_M = (15.0, 27.0)  # the way of a cyclist to the meeting
_BEFORE_S = (2.5, 10.0)
_AFTER_S = (3.0, 7.0)


@dataclass(frozen=True)
class _Meeting:
    """When and where the first two meet, which way the pedestrian goes (radians), seconds left."""

    at_s: float
    xy: FloatArray
    heading: float
    after_s: float


def random_encounters(seed: int, count: int) -> tuple[Scenario, ...]:
    """`count` scenarios of 1 to 3 cyclists and 1 to 3 pedestrians; the first n of a longer list
    with the same seed are the same n."""
    return tuple(_encounter(np.random.default_rng([seed, i]), seed, i) for i in range(count))


def _encounter(rng: np.random.Generator, seed: int, index: int) -> Scenario:
    speed = _between(rng, RIDE_MPS)
    before_s = float(np.clip(_between(rng, _BEFORE_M) / speed, *_BEFORE_S))
    meeting = _Meeting(
        before_s,
        np.array([5 + _between(rng, (-8, 8)), -13 + _between(rng, (4, 16))]),
        _between(rng, (-math.pi, math.pi)),
        _between(rng, _AFTER_S),
    )
    course, walk, ride = (_drawn(rng, table) for table in (COURSES, WALKS, RIDES))
    passing_m = _miss_m(rng)
    walkers = [_walker(rng, meeting, walk)]
    riders = [_rider(rng, meeting, course, ride, speed, passing_m)]
    for _ in range(_companions(rng)):
        walkers.append(_beside(rng, walkers[0], 0.0))
    for _ in range(_companions(rng)):
        if rng.random() < 0.5:
            riders.append(_beside(rng, riders[0], _between(rng, (0.6, 2.5))))
        else:
            other = _drawn(rng, COURSES)
            pace, miss_m = _between(rng, RIDE_MPS), _miss_m(rng)
            riders.append(_rider(rng, meeting, other, "rides on", pace, miss_m))
    paths = [("pedestrian", path) for path in walkers] + [("cyclist", path) for path in riders]
    first_s = min(path[0, 0] for _, path in paths)
    agents = []
    for number, (kind, path) in enumerate(paths, 1):
        path = np.round(path - [first_s, 0.0, 0.0], 2) + 0.0  # no minus zero in the file
        path = path[np.r_[True, np.diff(path[:, 0]) > 0]]
        agents.append(Agent(number, kind, path, SIZES_M[kind]))
    return Scenario(
        name=f"Encounter {seed}-{index:04d}",
        hazard="standard" if len(paths) == 2 else "multi-agent",
        expected="warning",
        vehicle="ebike" if rng.random() < 0.25 else "bicycle",
        agents=tuple(agents),
        story=f"{course}: the pedestrian {walk}, the cyclist at {speed:.1f} m/s {ride}; aimed "
        f"{passing_m:.1f} m apart.",
    )


def _walker(rng: np.random.Generator, meeting: _Meeting, walk: str) -> FloatArray:
    """Waypoints [n, 3] of a pedestrian who is at the meeting's place at its time."""
    t, after = meeting.at_s, meeting.after_s
    step = _direction(meeting.heading) * _between(rng, WALK_MPS)
    start, end = meeting.xy - step * t, meeting.xy + step * after
    if walk == "stands":
        start = end = meeting.xy
    if walk in {"stops", "sets off"}:
        change_s = t - _between(rng, (0.0, 2.0))
        change = meeting.xy - step * (t - change_s)
        start, end = (start, change) if walk == "stops" else (change, end)
        return _waypoints((0.0, start), (change_s, change), (t + after, end))
    return _waypoints((0.0, start), (t + after, end))


def _rider(
    rng: np.random.Generator, meeting: _Meeting, course: str, ride: str, speed: float, pass_m: float
) -> FloatArray:
    """Waypoints [n, 3] of a cyclist who aims to pass the meeting's place at `pass_m`."""
    turn = {"crossing": _between(rng, (0.7, 2.4)), "opposite": math.pi}.get(course, 0.0)
    turn += _between(rng, (-0.2, 0.2))
    heading = meeting.heading + turn * rng.choice([-1, 1])
    along = _direction(heading)
    aside = np.array([-along[1], along[0]]) * rng.choice([-1, 1])
    t, after = meeting.at_s, meeting.after_s
    aim = meeting.xy + aside * pass_m
    way_m = speed * t
    points: list[tuple[float, FloatArray]] = [(0.0, aim - along * way_m), (t, aim)]
    if course == "late turn":
        turn_s = _between(rng, (0.6, 2.5))
        corner = aim - along * speed * turn_s
        other = _direction(heading + _between(rng, (0.4, 1.4)) * rng.choice([-1, 1]))
        points[0] = (0.0, corner - other * speed * (t - turn_s))
        points.insert(1, (t - turn_s, corner))
    if ride == "stops":  # brakes for half a second to a second and a half, short of the aim
        short_m = min(_between(rng, (1.5, 6.0)), 0.4 * way_m)
        brake_s = _between(rng, (0.5, 1.5))
        stand = aim - along * short_m
        stop_s = max(t - short_m / speed, points[-2][0] + 0.1)
        slow = (stop_s, stand - along * min(0.4 * speed, 0.3 * short_m))
        return _waypoints(*points[:-1], slow, (stop_s + brake_s, stand), (t + after + 2, stand))
    if ride == "turns away":
        away = _direction(heading + _between(rng, (0.5, 1.6)) * rng.choice([-1, 1]))
        leave_s = max(t - _between(rng, (0.5, 2.0)), points[-2][0] + 0.1)
        corner = aim - along * speed * (t - leave_s)
        end = corner + away * speed * (t - leave_s + after)
        return _waypoints(*points[:-1], (leave_s, corner), (t + after, end))
    return _waypoints(*points, (t + after, aim + along * speed * after))


def _beside(rng: np.random.Generator, path: FloatArray, later_s: float) -> FloatArray:
    """The same way, some steps aside and `later_s` later."""
    shift = _direction(_between(rng, (-math.pi, math.pi))) * _between(rng, (0.6, 2.0))
    return np.asarray(path + np.array([later_s, *shift]))


def _miss_m(rng: np.random.Generator) -> float:
    return PASS_M * rng.random() * math.sqrt(rng.random())


def _companions(rng: np.random.Generator) -> int:
    return int(rng.choice([0, 1, 2], p=[0.7, 0.2, 0.1]))


def _waypoints(*points: tuple[float, FloatArray]) -> FloatArray:
    return np.asarray([[t, *xy] for t, xy in points])


def _direction(heading: float) -> FloatArray:
    return np.array([math.cos(heading), math.sin(heading)])


def _between(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(rng.uniform(*bounds))


def _drawn(rng: np.random.Generator, table: dict[str, float]) -> str:
    return str(rng.choice(list(table), p=list(table.values())))

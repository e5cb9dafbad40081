"""`BenchSettings`: everything that the test bench lets people change, with its ranges.

The settings of a run: the scenario shown, custom scenarios, the decision's parameters, the camera's
mount and its misses, the delay, and the ground truth's thresholds. They travel as JSON (the page's
requests), as a link (`settings_to_link`, `settings_from_link`: only what differs from the
configuration in force) and as a file (`bikeped testbench contest FILE`), without loss.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl, quote, urlsplit

import msgspec
from msgspec import Meta

from bikeped.config.build import ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.config.output_sections import Section
from bikeped.config.schema import DecisionConfig
from bikeped.errors import BikepedError, ScenarioError
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.experiments.latency import delay_frames
from bikeped.lab.scenarios.scenario import Scenario, parse_scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.simulation.perception import SIMULATION_POSE, RecallModel
from bikeped.lab.simulation.truth import GroundTruthSettings

#: Limits of custom scenarios: what one answer can simulate within a second.
MAX_SCRIPTS = 30
MAX_SCRIPT_CHARS = 60_000
MAX_AGENTS = 40
MAX_DURATION_S = 120.0
MAX_COORDINATE_M = 200.0
_MAX_LINK_CHARS = 900_000


class Pose(Section, frozen=True):
    """Position and heading of a camera in the plan."""

    x_m: Annotated[float, Meta(ge=-100, le=100)]
    """east, m"""
    y_m: Annotated[float, Meta(ge=-100, le=100)]
    """north, m"""
    heading_deg: Annotated[float, Meta(ge=-360, le=360)]
    """from east, counter-clockwise, degrees"""

    def pose(self) -> CameraPose:
        return CameraPose(self.x_m, self.y_m, self.heading_deg)


class Mount(Pose, frozen=True):
    """The camera's mount; the other parameters of the lens are the configuration's."""

    height_m: Annotated[float, Meta(ge=1, le=15)]
    """above the ground, m"""
    pitch_deg: Annotated[float, Meta(ge=-90, le=30)]
    """0 level, -90 straight down"""
    fov_deg: Annotated[float, Meta(ge=30, le=240)]
    """field of view, degrees"""


class Perception(Section, frozen=True):
    """Position errors and missed detections."""

    localisation_error: bool = True
    """use the positions that the camera measures, not the true ones"""
    recall: Literal["all", "size", "kind", "fixed"] = "all"
    """all: no misses; size: recall measured by size in the picture; kind: the measured overall
    recall of each kind; fixed: the number below"""
    recall_value: Annotated[float, Meta(ge=0.05, le=1)] = 0.75
    """share of detections that are made, with fixed"""
    burst_frames: Annotated[float, Meta(ge=1, le=1000)] | None = None
    """mean length of a run of misses, frames; null: independent misses"""
    seed: Annotated[int, Meta(ge=0, le=2**31)] = 0
    """seed of the misses"""
    trial: Annotated[int, Meta(ge=0, le=999)] = 0
    """which random trial is shown"""
    trials: Annotated[int, Meta(ge=1, le=50)] = 10
    """trials over which the suite's means are taken"""

    def model(self) -> RecallModel | None:
        """The recall model; None without misses."""
        if self.recall == "all":
            return None
        if self.recall == "fixed":
            return RecallModel("curve", ((0.0,), (self.recall_value,)))
        return RecallModel("size" if self.recall == "size" else "flat")


class Delay(Section, frozen=True):
    """Camera latency, and the prediction of tracks over it."""

    delay_ms: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    """age of every picture, ms"""
    order: Literal[0, 1, 2] = 0
    """prediction over the delay: 0 none, 1 velocity, 2 acceleration too"""

    @property
    def frames(self) -> int:
        return delay_frames(self.delay_ms)


class GroundTruthThresholds(Section, frozen=True):
    """The free thresholds of the ground truth (definitions, section 5)."""

    cpa_radius_m: Annotated[float, Meta(gt=0, le=25)] = 5.0
    """largest distance at the closest approach that is dangerous, m"""
    stopping_margin: Annotated[float, Meta(gt=0, le=10)] = 0.8
    """share of the gap that the stopping distance must reach"""
    ttc_bound_s: Annotated[float, Meta(gt=0, le=60)] | None = None
    """time to contact below which danger holds, s; null: 1.87 s + clearance"""
    braking: Literal["bicycle", "ebike", "aashto"] | None = None
    """braking of all cyclists; null: by the scenario's vehicle"""

    def settings(self) -> GroundTruthSettings:
        return GroundTruthSettings(
            self.cpa_radius_m, self.stopping_margin, self.ttc_bound_s, self.braking
        )


class BenchSettings(Section, frozen=True):
    """All settings of the test bench."""

    camera: Mount
    decision: DecisionConfig = msgspec.field(default_factory=DecisionConfig)
    perception: Perception = msgspec.field(default_factory=Perception)
    delay: Delay = msgspec.field(default_factory=Delay)
    danger: GroundTruthThresholds = msgspec.field(default_factory=GroundTruthThresholds)
    second_camera: Pose | None = None
    scenario: Annotated[str, Meta(max_length=200)] = ""  #: the one shown; empty: the first
    #: Named configurations that are shown beside `decision`.
    beside: Annotated[tuple[Annotated[str, Meta(max_length=60)], ...], Meta(max_length=2)] = ()
    #: Texts of custom scenario files; one with a bundled scenario's name replaces it.
    scripts: Annotated[
        tuple[Annotated[str, Meta(max_length=MAX_SCRIPT_CHARS)], ...], Meta(max_length=MAX_SCRIPTS)
    ] = ()


def settings_in_force(loaded: LoadedConfig) -> BenchSettings:
    """The settings without changes: the configuration's decision and camera, at the position of the
    paper's simulation camera."""
    camera = ground_camera(loaded)
    fov_deg = loaded.config.camera.fov_deg
    if fov_deg is None and loaded.calibration is not None:
        fov_deg = loaded.calibration.fov_deg
    return BenchSettings(
        camera=Mount(
            **dataclasses.asdict(SIMULATION_POSE),
            height_m=camera.height_m,
            pitch_deg=camera.pitch_deg,
            fov_deg=fov_deg or 180.0,
        ),
        decision=loaded.config.decision,
    )


def camera_with_mount(loaded: LoadedConfig, mount: Mount) -> GroundCamera:
    """The configuration's camera with the mount's height, pitch and field of view.

    The same camera as `--set camera.height_m=...` and so on give.
    """
    before = settings_in_force(loaded).camera
    keys = ("height_m", "pitch_deg", "fov_deg")
    changed = {k: getattr(mount, k) for k in keys if getattr(mount, k) != getattr(before, k)}
    camera = msgspec.structs.replace(loaded.config.camera, **changed)
    config = msgspec.structs.replace(loaded.config, camera=camera)
    return ground_camera(dataclasses.replace(loaded, config=config))


def check_settings(bench: BenchSettings) -> BenchSettings:
    """Checks keys against one another; BikepedError names key and remedy."""
    low_m, high_m = bench.decision.d_min_m, bench.decision.d_max_m
    if low_m > high_m:
        raise BikepedError(
            f"decision.d_min_m: {low_m:g} is above decision.d_max_m {high_m:g}; exchange them"
        )
    return bench


def custom_scenarios(
    bench: BenchSettings, parse: Callable[[str, str], Scenario]
) -> dict[str, Scenario]:
    """The custom scenarios by name, each from `parse(text, source)`; ScenarioError when two share a
    name."""
    found: dict[str, Scenario] = {}
    for number, text in enumerate(bench.scripts, 1):
        scenario = parse(text, f"scenario {number}")
        if scenario.name in found:
            raise ScenarioError(f"scenario {scenario.name!r}: occurs twice; rename one of them")
        found[scenario.name] = scenario
    return found


def parse_custom_scenario(text: str, source: str) -> Scenario:
    """A custom scenario; ScenarioError when it is invalid or exceeds the limits of the page."""
    scenario = parse_scenario(text, source)
    if len(scenario.agents) > MAX_AGENTS:
        raise ScenarioError(
            f"{source}: agents: {len(scenario.agents)} are too many for the page (at most "
            f"{MAX_AGENTS}); use bikeped conformance run --scenarios"
        )
    if scenario.duration_s > MAX_DURATION_S:
        raise ScenarioError(
            f"{source}: lasts {scenario.duration_s:g} s, the page takes {MAX_DURATION_S:g} s; "
            "use bikeped conformance run --scenarios"
        )
    if any(abs(agent.path[:, 1:]).max() > MAX_COORDINATE_M for agent in scenario.agents):
        raise ScenarioError(f"{source}: a position is over {MAX_COORDINATE_M:g} m away; use metres")
    return scenario


# --- as a link


def settings_to_link(bench: BenchSettings, base: BenchSettings) -> str:
    """The keys that differ from `base` as `key=value&...`, e.g. `decision.d_max_m=15`."""
    return "&".join(
        f"{key}={quote(value_text(value), safe='')}"
        for key, _, value in differing_keys(bench, base)
    )


def value_text(value: Any) -> str:
    """A value of a setting as in links and in `--set key=value`."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


#: Keys that choose what the page shows, and change no figure of the suite.
VIEW_KEYS = ("scenario", "beside")


def differing_keys(bench: BenchSettings, base: BenchSettings) -> list[tuple[str, Any, Any]]:
    """[(key, value in `base`, value in `bench`), ...] where they differ, as `decision.d_max_m`."""
    now, before = msgspec.to_builtins(bench), msgspec.to_builtins(base)
    found: list[tuple[str, Any, Any]] = []
    for key, value in now.items():
        old = before[key]
        if isinstance(value, dict) and isinstance(old, dict):
            found += [(f"{key}.{k}", old[k], v) for k, v in value.items() if v != old[k]]
        elif value != old:
            found.append((key, old, value))
    return found


def settings_from_link(link: str, base: BenchSettings) -> BenchSettings:
    """The settings of a link: a whole address or what follows its `#`.

    BikepedError names key and remedy.
    """
    if len(link) > _MAX_LINK_CHARS:
        raise BikepedError("link: too long; use the file instead")
    text = urlsplit(link.strip()).fragment if "#" in link else link.strip()
    data = msgspec.to_builtins(base)
    try:
        items = parse_qsl(text, keep_blank_values=True, strict_parsing=bool(text), errors="strict")
    except ValueError as error:
        raise BikepedError("link: expected key=value&key=value; copy all of it") from error
    for key, value in items:
        section, dot, name = key.partition(".")
        place = data.get(section) if dot else data
        if not isinstance(place, dict) or (name if dot else key) not in place:
            raise BikepedError(f"link: {key[:60]}: there is no such setting; copy the link again")
        place[name if dot else key] = _value(value, key)
    return _bench(data, "link")


def _value(text: str, key: str) -> Any:
    if key == "scenario":
        return text
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError):
        return text  # a word: decision.rule=ttc


# --- as a file


def settings_to_file(bench: BenchSettings, base: BenchSettings, facts: dict[str, Any]) -> str:
    """A file of all settings, with the hashes that they were measured with."""
    settings = {"link": settings_to_link(bench, base), "bench": msgspec.to_builtins(bench)}
    return json.dumps({"format": 1, **facts, **settings}, indent=2, allow_nan=False) + "\n"


def settings_from_file(text: str | bytes, source: str) -> BenchSettings:
    """The settings of a saved file; BikepedError names file, key and remedy."""
    try:
        data = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise BikepedError(
            f"{source}: is not JSON ({error}); save the file again in the test bench"
        ) from error
    if not isinstance(data, dict) or data.get("format") != 1 or "bench" not in data:
        raise BikepedError(f"{source}: is not a file of the test bench; save it there")
    return _bench(data["bench"], source)


def _bench(data: Any, source: str) -> BenchSettings:
    try:
        return check_settings(msgspec.convert(data, BenchSettings, strict=True))
    except msgspec.ValidationError as error:
        raise BikepedError(f"{source}: {error}; correct it there") from error

"""Camera deployment: road widths, one or two poles, mounting height and pitch.

Definitions, section 11. What it leaves open: the lens is equidistant with 220 degrees
in the deployed camera's image circle (radius, optical centre and sensor window unchanged); the
cyclist rides across the pedestrian's way in the middle of the road, so that both would be at
(5, 0) at the same time, and rides on for 10 m; the pedestrian walks from kerb to kerb.

Two cameras: an object is detected with probability 1 - (1 - AR1)(1 - AR2), at the position of the
camera in whose image it is larger, in the first camera's ground frame.

An object without a visible corner keeps its true position and the recall of the smallest objects
(definitions, section 3). That flatters a camera that looks past the crossing, so every row also
holds the result when such an object is never detected (`visible_only`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bikeped.config.schema import DecisionConfig
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.lens import Lens
from bikeped.lab.experiments.trials import (
    DetectableObjects,
    LossModel,
    simulate_views,
    summarize_metrics,
)
from bikeped.lab.process_pool import ProgressCallback, no_progress
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.simulation.metrics import GroundTruthFrames, measure
from bikeped.lab.simulation.paper_tracker import MAX_UNSEEN_FRAMES
from bikeped.lab.simulation.perception import PerceptionResult, RecallModel, simulate_perception
from bikeped.lab.simulation.simulate import (
    PAPER,
    DetectionSequence,
    SimulatedTracker,
    TrackHistory,
    build_rule_input,
    outcome,
)
from bikeped.lab.simulation.truth import compute_ground_truth
from bikeped.types import BoolArray, FloatArray

FOOT_M = 0.3048
WIDTHS_FT = (30, 40, 50, 60)
MOUNTS = ((5.5, 0.0), (2.5, -40.0))  #: height m, pitch degrees
HEIGHTS_M = tuple(1.5 + 0.5 * i for i in range(13))
PITCHES_DEG = tuple(0.0 - 10 * i for i in range(10))
FOV_DEG = 220.0
PLACEMENT_WIDTH_FT = 40
PLACEMENT_TRIALS = 20
DEPLOYMENT_TRIALS = 200
CROSSING_X_M = 5.0
WALK_MPS = 1.3
RIDE_MPS = 8.3
RIDE_FROM_M = 20.0
RIDE_ON_M = 10.0
_SIZE = RecallModel("size")


def road_scenario(width_ft: float) -> Scenario:
    """The crossing of one road: both would be at (5, 0) at the same time."""
    width = width_ft * FOOT_M
    meet_s = width / 2 / WALK_MPS
    start_s = meet_s - RIDE_FROM_M / RIDE_MPS
    end_s = meet_s + RIDE_ON_M / RIDE_MPS
    if start_s < 0:
        raise ValueError(f"width_ft: {width_ft:g} is too narrow; use 21 or more")
    walk = np.array([[0.0, CROSSING_X_M, -width / 2], [width / WALK_MPS, CROSSING_X_M, width / 2]])
    ride = np.array(
        [[start_s, CROSSING_X_M - RIDE_FROM_M, 0.0], [end_s, CROSSING_X_M + RIDE_ON_M, 0.0]]
    )
    agents = (
        Agent(1, "pedestrian", walk, SIZES_M["pedestrian"]),
        Agent(2, "cyclist", ride, SIZES_M["cyclist"]),
    )
    return Scenario(f"Road of {width_ft:g} ft", "standard", "warning", "bicycle", agents)


def wide_camera(camera: GroundCamera, height_m: float, pitch_deg: float) -> GroundCamera:
    """The deployed camera with a lens of 220 degrees, at another height and pitch."""
    radius = float(camera.lens.radius(np.asarray(camera.lens.max_theta_rad)))
    lens = Lens.from_circle("equidistant", radius, FOV_DEG)
    return replace(camera, lens=lens, height_m=height_m, pitch_deg=pitch_deg, heading_deg=0.0)


def camera_poses(width_ft: float, cameras: int) -> tuple[CameraPose, ...]:
    """One pole at the near kerb, or a second opposite, looking back."""
    half = width_ft * FOOT_M / 2
    near, far = CameraPose(CROSSING_X_M, -half, 90.0), CameraPose(CROSSING_X_M, half, 270.0)
    return (near,) if cameras == 1 else (near, far)


def detectable_objects(
    scenario: Scenario,
    camera: GroundCamera,
    poses: Sequence[CameraPose],
    recall: RecallModel = _SIZE,
    visible_only: bool = False,
) -> DetectableObjects:
    """What one camera, or several fused, can detect; see the module's docstring."""
    seen = [simulate_perception(scenario, camera, pose) for pose in poses]
    return fuse_cameras(scenario.name, seen, poses, recall, visible_only)


def fuse_cameras(
    name: str,
    seen: Sequence[PerceptionResult],
    poses: Sequence[CameraPose],
    recall: RecallModel = _SIZE,
    visible_only: bool = False,
) -> DetectableObjects:
    """As `detectable_objects`, from each camera's perception (`seen`, at `poses`) of a scenario."""
    rates = [np.where((not visible_only) | (s.area_px2 > 0), s.recall(recall), 0.0) for s in seen]
    xy, area = seen[0].observed_m, seen[0].area_px2
    for pose, other in zip(poses[1:], seen[1:], strict=True):
        moved = poses[0].world_to_ground(pose.ground_to_world(other.observed_m))
        larger = other.area_px2 > area
        xy = np.where(larger[..., None], moved, xy)
        area = np.maximum(area, other.area_px2)
    missed = np.prod([1 - rate for rate in rates], axis=0)
    return DetectableObjects(name, xy, 1 - missed, seen[0].present, seen[0].kind)


def _measure_views(
    scenario: Scenario,
    views: Sequence[tuple[GroundCamera, Sequence[CameraPose]]],
    decision: DecisionConfig,
    trials: int,
    seed: int,
    recall: RecallModel,
    tracker: SimulatedTracker,
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """By view: summaries over trials by the definition, and with invisible objects undetected."""
    truth = GroundTruthFrames.join([compute_ground_truth(scenario)])
    observed = [
        [detectable_objects(scenario, camera, poses, recall, visible_only)]
        for visible_only in (False, True)
        for camera, poses in views
    ]
    found = simulate_views(
        observed, truth, LossModel(recall, None), {"": decision}, range(trials), seed, tracker
    )
    results = [summarize_metrics(part[0, 0][""]) for part in found]
    return list(zip(results[: len(views)], results[len(views) :], strict=True))


def _true_positions(
    scenario: Scenario,
    views: Sequence[tuple[GroundCamera, Sequence[CameraPose]]],
    decision: DecisionConfig,
    trials: int,
    seed: int,
    recall: RecallModel,
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """`_measure_views` as the paper has it: who is detected counts, where it truly is."""
    truth = GroundTruthFrames.join([compute_ground_truth(scenario)])
    truth = replace(truth, actionable=truth.danger)  # all frames with danger
    settings = replace(PAPER.rule(decision), count_all=False)
    results = []
    for visible_only in (False, True):
        for camera, poses in views:
            seen = simulate_perception(scenario, camera, poses[0])
            objects = detectable_objects(scenario, camera, poses, recall, visible_only)
            metrics = []
            for found in objects.trials(range(trials), seed, None):
                run = build_rule_input(history_of(seen.true_m, seen.present, found), 0, settings)
                states = outcome(run, settings).raw
                metrics.append(measure(truth, states))
            results.append(summarize_metrics(metrics))
    return list(zip(results[: len(views)], results[len(views) :], strict=True))


def history_of(true_m: FloatArray, present: BoolArray, found: DetectionSequence) -> TrackHistory:
    """One scene's agents as tracks at their true places [f, a, 2]; those count that were detected
    within the frames that the paper's tracker keeps a track."""
    frames, agents = present.shape
    number = np.arange(frames)[:, None]
    last = np.maximum.accumulate(np.where(found.detected, number, -frames))
    kept = number - last <= MAX_UNSEEN_FRAMES
    one = (frames, 1, agents)
    return TrackHistory(
        reported=present[:, None],
        id=np.broadcast_to(np.arange(1, agents + 1), one),
        kind=np.broadcast_to(found.kind, one),
        xy_m=np.nan_to_num(true_m)[:, None],
        velocity_mps=np.zeros((*one, 2)),
        acceleration_mps2=np.zeros((*one, 2)),
        seen_s=np.full(one, np.inf),
        parked=~kept[:, None],
        frames=np.asarray([frames]),
        delay_frames=np.zeros(1, np.int64),
    )


def deployment(
    camera: GroundCamera,
    tracker: SimulatedTracker,
    decision: DecisionConfig,
    trials: int = DEPLOYMENT_TRIALS,
    seed: int = 0,
    recall: RecallModel = _SIZE,
    progress: ProgressCallback = no_progress,
) -> ExperimentResult:
    """Road widths, one camera and two, both mounts. Progress counts widths."""
    cases = [(height, pitch, cameras) for height, pitch in MOUNTS for cameras in (1, 2)]
    rows: list[dict[str, Any]] = []
    for count, width in enumerate(WIDTHS_FT, 1):
        views = [(wide_camera(camera, h, p), camera_poses(width, n)) for h, p, n in cases]
        found = _measure_views(road_scenario(width), views, decision, trials, seed, recall, tracker)
        rows += [
            {
                "width_ft": width,
                "cameras": cameras,
                "height_m": height,
                "pitch_deg": pitch,
                **by_definition,
                "visible_only": visible,
            }
            for (height, pitch, cameras), (by_definition, visible) in zip(cases, found, strict=True)
        ]
        progress(count)
    rows.sort(key=lambda r: (-r["height_m"], r["cameras"], r["width_ft"]))
    data = {
        "rows": rows,
        "trials": trials,
        "seed": seed,
        "recall": recall.mode,
        "fov_deg": FOV_DEG,
        "tracker": tracker.name,
    }
    table = ResultTable.of(
        "deployment",
        "Road widths, one camera and two",
        rows,
        {
            "height, m": "height_m",
            "pitch, degrees": "pitch_deg",
            "cameras": "cameras",
            "width, ft": "width_ft",
            "sens, %": "sensitivity.mean",
            "from, %": "sensitivity.low",
            "to, %": "sensitivity.high",
            "spec, %": "specificity.mean",
            "visible only, %": "visible_only.sensitivity.mean",
        },
        f"{trials} trials; from and to: 95 % confidence interval of the mean; visible only: "
        "objects that no camera sees are never detected",
    )
    return ExperimentResult("deployment", data, (table,))


def placement(
    camera: GroundCamera,
    tracker: SimulatedTracker,
    decision: DecisionConfig,
    trials: int = PLACEMENT_TRIALS,
    seed: int = 0,
    recall: RecallModel = _SIZE,
    progress: ProgressCallback = no_progress,
    *,
    paper: bool = False,
) -> ExperimentResult:
    """Height by pitch on a road of 40 ft, one camera. Progress counts heights.

    `paper`: as the paper's grid, without localisation error, over all danger frames, and with the
    true positions of what was detected in place of a tracker.
    """
    scenario = road_scenario(PLACEMENT_WIDTH_FT)
    poses = camera_poses(PLACEMENT_WIDTH_FT, 1)
    grids: dict[str, list[list[float | None]]] = {
        "sensitivity": [],
        "specificity": [],
        "visible_only_sensitivity": [],
    }
    for count, height in enumerate(HEIGHTS_M, 1):
        views = [(wide_camera(camera, height, pitch), poses) for pitch in PITCHES_DEG]
        if paper:
            found = _true_positions(scenario, views, decision, trials, seed, recall)
        else:
            found = _measure_views(scenario, views, decision, trials, seed, recall, tracker)
        for key in ("sensitivity", "specificity"):
            grids[key].append([by_definition[key]["mean"] for by_definition, _ in found])
        grids["visible_only_sensitivity"].append([v["sensitivity"]["mean"] for _, v in found])
        progress(count)
    data = {
        "height_m": list(HEIGHTS_M),
        "pitch_deg": list(PITCHES_DEG),
        **grids,
        "width_ft": PLACEMENT_WIDTH_FT,
        "tracker": "none: true positions" if paper else tracker.name,
        "localisation_error": not paper,
        "trials": trials,
        "seed": seed,
        "recall": recall.mode,
        "fov_deg": FOV_DEG,
    }
    how = f"with localisation error and the tracker {tracker.name}"
    if paper:
        how = "as the paper: true positions of what was detected, all frames with danger"
    columns = {f"{pitch:g}\N{DEGREE SIGN}, %": str(i) for i, pitch in enumerate(PITCHES_DEG)}
    tables = tuple(
        ResultTable.of(
            name,
            title,
            [
                {"height": height, **{str(i): value for i, value in enumerate(row)}}
                for height, row in zip(HEIGHTS_M, grids[grid], strict=True)
            ],
            {"height, m": "height", **columns},
            f"{trials} trials a cell; {how}",
        )
        for name, title, grid in (
            ("placement", "Sensitivity by height and pitch", "sensitivity"),
            (
                "placement_visible_only",
                "Sensitivity by height and pitch, objects out of sight never detected",
                "visible_only_sensitivity",
            ),
        )
    )
    return ExperimentResult("placement", data, tables)

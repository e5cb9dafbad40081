"""The batch simulation decides as the deployed classes do, and as the definition's plain rule."""

import math
from dataclasses import replace

import numpy as np
import pytest
from detection_losses import misses

from bikeped.config.build import rule_settings
from bikeped.config.load import load_config
from bikeped.decision.decider import Decider
from bikeped.decision.who_counts import counts
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.perception import RecallModel, trial_generator
from bikeped.lab.simulation.simulate import (
    FPS,
    PAPER,
    DetectionSequence,
    SimulatedTracker,
    build_rule_input,
    outcome,
    track,
)
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.tracking.tracker import Tracker, predict
from bikeped.types import GroundPoints, State

NAMES = [s.name for s in load_scenarios(bundled_folder())]
SELECTED = rule_settings(CONFIGURATIONS["selected"])
ORDERS = (0, 1, 2)
TRACKER = SimulatedTracker.of(load_config(None))


def deployed(scene, rules, orders=(0,)):
    """States [orders, f] of the pole's own tracker and decider, one frame after the other."""
    tracker = Tracker(TRACKER.settings)
    deciders = [Decider(rules) for _ in orders]
    found = []
    for frame in range(len(scene.xy_m)):
        seen = frame - scene.delay_frames
        there = scene.detected[seen] if seen >= 0 else np.zeros(len(scene.kind), np.bool_)
        xy = scene.xy_m[max(seen, 0)][there]
        points = GroundPoints(scene.kind[there], xy, np.flatnonzero(there))
        tracks = tracker.update(points, frame / FPS)
        velocity, acceleration = tracker.smoothed()
        found.append([])
        for order, decider in zip(orders, deciders, strict=True):
            ahead = predict(tracks.xy_m, velocity, acceleration, scene.delay_frames / FPS, order)
            counted = counts(tracks.unseen_s, tracker.parked(), rules.max_unseen_s)
            decision = decider.decide(frame / FPS, tracks.id, tracks.kind, ahead, velocity, counted)
            found[-1].append(int(decision.raw))
    return np.array(found, np.int8).T


def simulated(scenes, rules, order=0):
    run = build_rule_input(track(scenes, TRACKER), order)
    found = outcome(run, rules).raw
    return [found[run.frame_slice(lane)] for lane in range(len(scenes))]


def variants(suite, index):
    """One scenario as it is asked below: (localisation error, delay) to its scene."""
    seen = suite.perception_results[index]
    return {
        (error, delay): DetectionSequence(
            seen.observed_m if error else seen.true_m, seen.present, seen.kind, delay
        )
        for error in (True, False)
        for delay in (0, 6)
    }


@pytest.fixture(scope="module")
def batch(suite):
    """All scenarios and variants in one tracker, by predictor order."""
    scenes, keys = [], []
    for index, name in enumerate(suite.names):
        for key, scene in variants(suite, index).items():
            scenes.append(scene)
            keys.append((name, *key))
    tracked = track(scenes, TRACKER)
    out = {}
    for order in ORDERS:
        run = build_rule_input(tracked, order)
        found = outcome(run, SELECTED).raw
        for lane, key in enumerate(keys):
            out[(*key, order)] = found[run.frame_slice(lane)]
    return out


@pytest.mark.parametrize("name", NAMES)
def test_lanes_together_equal_the_pole_frame_by_frame(suite, batch, name):
    for (error, delay), scene in variants(suite, suite.names.index(name)).items():
        orders = ORDERS if delay else (0,)
        for order, expected in zip(orders, deployed(scene, SELECTED, orders), strict=True):
            assert batch[name, error, delay, order].tolist() == expected.tolist(), (error, delay)


@pytest.mark.parametrize("name", NAMES)
def test_a_monte_carlo_trial_equals_the_pole_frame_by_frame(suite, name):
    seen = suite.perception_results[suite.names.index(name)]
    kind = np.broadcast_to(seen.kind, seen.area_px2.shape)
    recall = RecallModel().recall(kind, seen.area_px2)
    scenes = []
    for trial, burst in ((0, None), (1, 5.0)):
        missed = misses(recall, seen.present, trial_generator(0, name, trial), burst)
        scenes.append(DetectionSequence(seen.observed_m, seen.present & ~missed, seen.kind))
    for scene, found in zip(scenes, simulated(scenes, SELECTED), strict=True):
        assert found.tolist() == deployed(scene, SELECTED)[0].tolist()


@pytest.mark.parametrize("configuration", list(CONFIGURATIONS))
def test_every_configuration_equals_the_pole(suite, configuration):
    rules = rule_settings(CONFIGURATIONS[configuration])
    names = ("Speed Variant", "Dense Pedestrian Group", "Parallel Paths", "U-Turn Cyclist")
    found = suite.outcome(CONFIGURATIONS[configuration]).raw
    for name in names:
        index = suite.names.index(name)
        own = found[suite.truth_frames.scenario == index]
        expected = deployed(suite.detection_sequences()[index], rules)[0]
        assert own.tolist() == expected.tolist(), name


# ---- the definition's rule, plainly, on positions that are seen in every frame


def plain(scenario, seen, config):
    """States of one scenario by algorithm 1, positions straight from the camera (no tracker).

    Holds while every agent is seen from its first to its last frame and nobody is coasting, that
    is until the first agent ends.
    """
    k = config.lookback_frames
    last = min(int(np.flatnonzero(there)[-1]) for there in seen.present.T)
    cyclists = [i for i, c in enumerate(seen.kind) if c == 1]
    pedestrians = [i for i, c in enumerate(seen.kind) if c == 0]
    out, remembered = [], -math.inf
    for f in range(last + 1):
        here = [i for i in range(len(seen.kind)) if seen.present[f, i]]
        if any(c in here for c in cyclists):
            remembered = f
        if not any(p in here for p in pedestrians):
            out.append(State.IDLE)
            continue
        if f - remembered > config.memory_frames:
            out.append(State.SAFE)
            continue
        fired = any(
            fires(seen, config, f, c, p, k)
            for c in cyclists
            for p in pedestrians
            if c in here and p in here
        )
        out.append(State.ALERT if fired else State.WARNING)
    return out


def fires(seen, config, f, c, p, k):
    def at(frame, agent):
        x, y = seen.observed_m[frame, agent]
        return float(x), float(y)

    first = max(int(np.flatnonzero(seen.present[:, i])[0]) for i in (c, p))
    born = int(np.flatnonzero(seen.present[:, c])[0])
    then = max(f - k, first)
    now_c, now_p, old_c, old_p = at(f, c), at(f, p), at(then, c), at(then, p)
    d = math.dist(now_c, now_p)
    d_max = config.d_max_m
    if config.speed_adaptive and f > born:
        v = math.dist(now_c, at(max(f - 4, born), c)) / (min(4, f - born) / 30)
        d_max = max(d_max, v * 0.84 + v * v / (2 * 1.96))
    if not config.d_min_m <= d <= d_max or (then == f and config.rule != "distance"):
        return False
    if math.hypot(*now_c) > 25 or math.hypot(*now_p) > 25:
        return False
    moved = math.dist(now_c, old_c) > config.min_displacement_m
    if config.rule == "distance":
        return True
    if config.rule == "ttc":
        closing = (math.dist(old_c, old_p) - d) / ((f - then) / 30)
        return closing > 0.1 and d / closing < 3.0
    if config.rule == "naive":
        return d < math.dist(old_c, now_p) and moved
    return d < math.dist(old_c, old_p) - 1e-9 and moved


@pytest.mark.parametrize("configuration", [n for n in CONFIGURATIONS if n != "predictive"])
def test_states_by_a_plain_reading_of_the_algorithm(suite, configuration):
    config = CONFIGURATIONS[configuration]
    by_paper = replace(suite, tracker=PAPER)  # whose tracks are where detections are
    found = by_paper.states(config)
    for index, (scenario, seen) in enumerate(
        zip(suite.scenarios, suite.perception_results, strict=True)
    ):
        if scenario.name == "Dense Pedestrian Group":
            continue  # its people pass nearer to one another than the tracker tells apart
        own = found[suite.truth_frames.scenario == index]
        expected = plain(scenario, seen, config)
        assert own[: len(expected)].tolist() == [int(s) for s in expected], scenario.name

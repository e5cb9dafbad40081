"""Simulated perception: localisation error, projected area, recall and lost detections."""

import math

import numpy as np
import pytest
from detection_losses import misses

from bikeped.lab.experiments.trials import DetectableObjects
from bikeped.lab.simulation.perception import (
    OVERALL_RECALL,
    RecallModel,
    error_table,
    localise,
    missed_detections,
    trial_generator,
)
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.types import Kind

PAPER = {
    "pedestrian": {3: 0.248, 5: 0.249, 10: 0.249, 15: 0.249, 25: 0.250},
    "cyclist": {3: 0.223, 5: 0.249, 10: 0.273, 15: 0.282, 25: 0.289},
    "car": {3: 0.387, 5: 0.556, 10: 0.723, 15: 0.783, 25: 0.830},
}
# The deployed camera, written out: definitions, section 2.
FOCAL = 2 * 1750 * 180 / (197.90 * math.pi)
CX, CY, HEIGHT = 1752.69, 1804.54, 3.6576


def by_hand(x, y, direction, size):
    """The tightest rectangle around the seen corners of one box: (u0, v0, u1, v1), or None."""
    us, vs = [], []
    for a in (-size[0] / 2, size[0] / 2):
        for b in (-size[1] / 2, size[1] / 2):
            for z in (0.0, size[2]):
                px = x + a * direction[0] - b * direction[1]
                py = y + a * direction[1] + b * direction[0]
                if px <= 0.01:
                    continue
                off = math.hypot(py, z - HEIGHT)
                theta = math.atan2(off, px)
                u = CX + FOCAL * theta * py / off
                v = CY - FOCAL * theta * (z - HEIGHT) / off
                if 0 <= u < 3500 and 670 <= v < 2830 and theta < math.radians(197.90 / 2):
                    us.append(u)
                    vs.append(v)
    return (min(us), min(vs), max(us), max(vs)) if us else None


def ground_by_hand(u, v):
    """The ground below a pixel, or None on and above the horizon."""
    theta = math.hypot(u - CX, v - CY) / FOCAL
    off = theta * FOCAL
    down = -math.sin(theta) * (v - CY) / off
    if down >= 0:
        return None
    reach = -HEIGHT / down
    return math.cos(theta) * reach, math.sin(theta) * (u - CX) / off * reach


@pytest.mark.parametrize("kind", PAPER)
def test_localisation_errors_of_the_paper(suite, kind):
    rows = {
        (r["distance_m"], r["bearing_deg"]): r["error_m"]
        for r in error_table(suite.camera)
        if r["kind"] == kind
    }
    assert len(rows) == 7 * 4
    for distance, expected in PAPER[kind].items():
        assert rows[distance, 0] == pytest.approx(expected, abs=0.0015)
    at_80 = {"pedestrian": (0.35, 0.0055), "cyclist": (0.89, 0.005), "car": (2.5, 0.05)}[kind]
    assert rows[10, 80] == pytest.approx(at_80[0], abs=at_80[1])
    assert all(error < 0.84 for (_, bearing), error in rows.items() if bearing == 0)


def test_every_agent_of_the_24_lies_where_a_scalar_projection_puts_it(suite):
    compared = 0
    for scenario, seen in zip(suite.scenarios, suite.perception_results, strict=True):
        times = scenario.frame_times()
        for index, agent in enumerate(scenario.agents):
            for frame in range(7, len(times), 29):
                place = agent.at(times[frame])
                assert seen.present[frame, index] == (place is not None)
                if place is None:
                    assert np.isnan(seen.observed_m[frame, index]).all()
                    continue
                (east, north), heading = place
                x, y = north + 13.0, east - 5.0  # camera ground frame: forward north, right east
                assert seen.true_m[frame, index] == pytest.approx((x, y), abs=1e-9)
                box = by_hand(x, y, (math.sin(heading), math.cos(heading)), agent.size_m)
                put = box and ground_by_hand((box[0] + box[2]) / 2, box[3])
                area = (box[2] - box[0]) * (box[3] - box[1]) / 9 if box else 0.0
                assert seen.observed_m[frame, index] == pytest.approx(put or (x, y), abs=1e-6)
                assert seen.area_px2[frame, index] == pytest.approx(area, abs=1e-6)
                compared += box is not None
    assert compared > 500


def test_an_object_outside_the_picture_keeps_its_true_place(suite):
    behind = np.array([[-5.0, 0.0], [-0.5, 8.0]])
    put, area = localise(suite.camera, behind, np.array([[1.0, 0.0]] * 2), (0.3, 0.5, 1.7))
    assert put.tolist() == behind.tolist()
    assert area.tolist() == [0.0, 0.0]


def test_the_error_is_zero_nowhere_and_small_for_people_on_foot(suite):
    for seen in suite.perception_results:
        error = seen.error_m[:, seen.kind == int(Kind.PEDESTRIAN)]
        known = error[~np.isnan(error)]
        assert known.size == 0 or (known.min() > 0.01 and known.max() < 0.8)


# ---- recall


def test_recall_by_size_changes_at_32_and_96_squared():
    area = np.array([0.0, 1023.9, 1024.0, 9215.9, 9216.0, 1e6])
    recall = RecallModel("size").recall(np.zeros(6, np.int8), area)
    assert recall.tolist() == [0.514, 0.514, 0.725, 0.725, 0.832, 0.832]


def test_overall_recall_by_kind():
    kind = np.array([0, 1, 2], np.int8)
    assert RecallModel("flat").recall(kind, np.ones(3)).tolist() == [0.755, 0.747, 0.765]
    assert list(OVERALL_RECALL.values()) == [0.755, 0.747, 0.765]


def test_a_recall_curve_is_interpolated_over_area():
    curve = RecallModel("curve", ((100.0, 300.0, 1100.0), (0.2, 0.6, 0.9)))
    area = np.array([50.0, 100.0, 200.0, 700.0, 5000.0])
    recall = curve.recall(np.zeros(5, np.int8), area)
    assert recall == pytest.approx([0.2, 0.2, 0.4, 0.75, 0.9])
    with pytest.raises(ValueError, match="recall curve"):
        RecallModel("curve").recall(np.zeros(1, np.int8), np.ones(1))


def test_near_agents_are_large_and_far_ones_small(suite):
    seen = suite.perception_results[suite.names.index("Bike Approaches Ped")]
    distance = np.hypot(*np.moveaxis(seen.true_m, -1, 0))
    for index in range(2):
        there = seen.present[:, index]
        near, far = np.nanargmin(distance[:, index]), np.nanargmax(distance[:, index])
        assert there[near]
        assert seen.area_px2[near, index] > 2 * seen.area_px2[far, index]


# ---- lost detections


def runs(row):
    """Lengths of the stretches of True."""
    edge = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
    return edge[1::2] - edge[::2]


@pytest.mark.parametrize("recall", [0.514, 0.755])
@pytest.mark.parametrize("burst", [None, 5.0, 12.0])
def test_loss_rate_and_mean_burst(recall, burst):
    shape = (20_000, 40)
    missed = misses(
        np.full(shape, recall), np.ones(shape, np.bool_), np.random.default_rng(7), burst
    )
    assert missed.mean() == pytest.approx(1 - recall, abs=0.008)
    assert missed[:1000].mean() == pytest.approx(1 - recall, abs=0.03)  # stationary from the start
    lengths = np.concatenate([runs(column) for column in missed.T])
    expected = 1 / recall if burst is None else burst
    assert lengths.mean() == pytest.approx(expected, rel=0.03)


def test_the_first_frame_of_an_agent_is_lost_as_often_as_any():
    present = np.zeros((30, 40_000), np.bool_)
    present[10:] = True
    missed = misses(np.full(present.shape, 0.7), present, np.random.default_rng(3), 8.0)
    assert not missed[:10].any()
    assert missed[10:].mean(axis=1) == pytest.approx(0.3, abs=0.012)


def test_a_gilbert_channel_against_one_agent_at_a_time():
    rng = np.random.default_rng(5)
    recall = rng.uniform(0.3, 0.95, (400, 6))
    present = np.zeros(recall.shape, np.bool_)
    for agent in range(6):
        present[20 * agent : 380 - 30 * agent, agent] = True
    draw = rng.random(recall.shape)
    for agent in range(6):
        expected, bad = [], None
        for x, r, here in zip(draw[:, agent], recall[:, agent], present[:, agent], strict=True):
            if not here:
                bad = False if bad is not None else None
            elif bad is None:
                bad = x >= r
            else:
                bad = x >= 1 / 4.0 if bad else x < (1 - r) / (4.0 * r)
            expected.append(bool(bad))
        assert missed_detections(draw, recall, present, 4.0)[:, agent].tolist() == expected


def test_what_is_absent_is_not_missed():
    present = np.zeros((50, 3), np.bool_)
    for burst in (None, 5.0):
        assert not misses(np.full((50, 3), 0.5), present, np.random.default_rng(1), burst).any()


def test_trials_draw_the_same_whatever_the_order():
    cases = [(seed, name, trial) for seed in (0, 1) for name in ("A", "B") for trial in range(3)]
    one = {c: trial_generator(*c).random(5).tolist() for c in cases}
    other = {c: trial_generator(*c).random(5).tolist() for c in reversed(cases)}
    assert one == other
    assert len({tuple(v) for v in one.values()}) == len(cases)


@pytest.mark.parametrize("burst", [None, 5.0])
def test_trials_of_a_scenario_are_the_same_alone_and_among_others(suite, burst):
    seen = suite.perception_results[suite.names.index("Dense Pedestrian Group")]
    observed = DetectableObjects.of("Dense Pedestrian Group", seen, RecallModel())
    together = observed.trials([4, 0, 2], 9, burst)
    for scene, trial in zip(together, (4, 0, 2), strict=True):
        alone = observed.trials([trial], 9, burst)[0]
        drawn = misses(
            observed.recall, seen.present, trial_generator(9, observed.name, trial), burst
        )
        assert (scene.detected == alone.detected).all()
        assert (scene.detected == (seen.present & ~drawn)).all()


def test_without_localisation_error_there_is_none(suite):
    with_error, without = suite.detection_sequences(True), suite.detection_sequences(False)
    for a, b, seen in zip(with_error, without, suite.perception_results, strict=True):
        assert np.array_equal(b.xy_m, seen.true_m, equal_nan=True)
        assert not np.array_equal(a.xy_m, b.xy_m, equal_nan=True)
    selected = CONFIGURATIONS["selected"]
    assert suite.measure(selected, True).specificity != suite.measure(selected, False).specificity

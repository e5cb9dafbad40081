"""Whom the decision counts: people seen a moment ago, no parked cycles, no riders twice."""

import numpy as np
import pytest
from campaign.people import C, P, decisions, lost, rider_with_a_person_box

from bikeped.types import State


@pytest.mark.parametrize("kind", [C, P])
def test_no_alert_comes_from_a_track_unseen_for_over_a_second(kind):
    alerts = 0
    for seed in range(200):
        for result in decisions(lost(seed, kind), 3.5):
            decision, tracks = result.decision, result.tracks
            if decision.raw is not State.ALERT:
                continue
            alerts += 1
            pair = [decision.pair.cyclist_id, decision.pair.pedestrian_id]
            assert (tracks.unseen_s[np.isin(tracks.id, pair)] <= 1 + 1e-6).all()
    assert alerts > 500


def test_a_lost_pedestrian_and_cyclist_are_gone_after_a_second():
    states = [r.decision.state for r in decisions(lost(3, P), 6)]
    assert set(states[round(2.2 * 30) + 45 :]) == {State.IDLE}


def test_a_rider_with_a_person_box_of_his_own_never_alerts():
    for seed in range(150):
        results = decisions(rider_with_a_person_box(seed), 3.5)
        assert State.ALERT not in {r.decision.state for r in results}, seed


def test_a_parked_bicycle_leaves_the_light_green_after_ten_seconds():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.05, (900, 2))

    def scene(t):
        return [(C, 8.0 + noise[round(t * 30), 0], 3.0), (P, 6.0, -4 + 1.2 * (t % 8))]

    states = [r.decision.state for r in decisions(scene, 20)]
    assert set(states[round(12.2 * 30) :]) == {State.SAFE}
    assert State.SAFE not in set(states[5 : 9 * 30])


@pytest.mark.parametrize("rider", ["beside", "joined"])
def test_a_rider_who_waits_at_a_signal_is_not_parked(rider):
    def scene(t):
        cycle = (C, 8.0, 3.0, "ridden") if rider == "joined" else (C, 8.0, 3.0)
        rest = [(P, 8.2, 3.2)] if rider == "beside" and round(t * 30) % 4 else []
        return [cycle, *rest, (P, 6.0, -4.0)]

    states = [r.decision.state for r in decisions(scene, 20)]
    assert set(states[5:]) == {State.WARNING}


def test_a_parked_bicycle_counts_again_once_it_moves():
    def scene(t):
        return [(C, 8.0 - 4 * max(t - 14, 0), 3.0), (P, -6.0, 3.0)]

    states = [r.decision.state for r in decisions(scene, 16)]
    assert states[round(13.9 * 30)] is State.SAFE
    assert states[round(14.5 * 30)] in (State.WARNING, State.ALERT)


def test_a_walker_whom_a_cyclist_overtakes_within_a_metre_is_warned():
    def scene(t):
        return [(C, 22 - 5 * t, 0.9), (P, 6 - 1.2 * t, 0.0)]

    states = [r.decision.state for r in decisions(scene, 3)]
    assert State.ALERT in states
    assert states.index(State.ALERT) < 30

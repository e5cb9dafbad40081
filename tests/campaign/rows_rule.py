"""Faults that only the decision can meet: rows 20 and 21."""

from __future__ import annotations

import numpy as np

from bikeped.types import State
from campaign.people import C, P, decisions, lost, parked, rider_with_a_person_box
from campaign.registry import row
from campaign.rig import Rig


@row(
    20,
    "a cyclist or a pedestrian is lost while they come together; two false boxes",
    "coasting is limited",
    "alerts from a track unseen over 1 s = 0 frames",
)
def ghosts(rig: Rig) -> None:
    false = 0
    for kind in (C, P):
        for seed in range(200):
            for result in decisions(lost(seed, kind), 3.5):
                if result.decision.raw is State.ALERT:
                    pair = result.decision.pair
                    both = np.isin(result.tracks.id, [pair.cyclist_id, pair.pedestrian_id])
                    false += bool((result.tracks.unseen_s[both] > 1 + 1e-6).any())
    rig.measure("alerts from a track unseen over 1 s", false)
    boxes = decisions(lambda t: [(C, 9.0, 3.0), (P, 5.0, 1.0)] if 1 <= t < 1.03 else [], 3)
    rig.expect(State.ALERT not in {r.decision.state for r in boxes}, "two false boxes alert")
    rig.saw("200 cyclists and 200 pedestrians lost")


@row(
    21,
    "a rider on a bicycle; a parked bicycle and a walker",
    "no rider alerts on himself",
    "alerts in 1,000 passes = 0",
)
def riders(rig: Rig) -> None:
    states = (
        {r.decision.state for r in decisions(rider_with_a_person_box(seed), 3.5)}
        for seed in range(1000)
    )
    rig.measure("alerts in 1,000 passes", sum(State.ALERT in found for found in states))
    late = {r.decision.state for r in decisions(parked, 30)[13 * 30 :]}
    rig.expect(late == {State.SAFE}, f"a parked bicycle and a walker show {late}")

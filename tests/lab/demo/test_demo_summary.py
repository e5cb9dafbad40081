import json
from pathlib import Path

import pytest
from drawn_detectors import boxes

from bikeped.config.load import load_config
from bikeped.lab.demo.summary import bundled_scenario, format_summary, summarise
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.scenarios.scenario import load_scenario
from bikeped.pipeline.track_and_decide import TrackAndDecide

CONFIG = Path(__file__).parents[3] / "config.yaml"


def event(t, state, pair=None, gap=10.0, lost=False, **more):
    tracks = [
        {"id": 1, "kind": "pedestrian", "x": 5.0, "y": 0.0, "lost": False},
        {"id": 2, "kind": "cyclist", "x": 5.0, "y": gap, "lost": lost},
    ]
    return {"t": t, "frame": round(t * 10), "state": state, "pair": pair, "tracks": tracks, **more}


def test_numbers_of_a_simple_run():
    events = [{"config_hash": "x", "version": "1"}]
    events += [event(0.1 * i, "SAFE") for i in range(10)]
    events += [event(1.0 + 0.1 * i, "ALERT", [2, 1], 10.0 - i) for i in range(5)]
    events += [
        event(1.5 + 0.1 * i, "WARNING", [2, 1], [5.0, 3.0, 4.0, 6.0, 8.0][i]) for i in range(5)
    ]
    summary = summarise(events, "A run")
    assert summary["frames"] == 20
    assert summary["duration_s"] == pytest.approx(1.9)
    assert summary["state_share"] == {"IDLE": 0.0, "SAFE": 0.5, "WARNING": 0.25, "ALERT": 0.25}
    assert summary["state_order"] == ["SAFE", "ALERT", "WARNING"]
    (alert,) = summary["alerts"]
    assert alert["t"] == pytest.approx(1.0)
    assert alert["pair"] == [2, 1]
    assert alert["distance_m"] == 10.0
    assert alert["lead_s"] == pytest.approx(0.6)
    assert alert["closest_m"] == 3.0
    assert "cyclist 2" in alert["sentence"]
    json.dumps(summary)


def test_flicker_is_one_alert_and_a_second_pass_is_another():
    events = [
        event(0.0, "ALERT", [2, 1], 9),
        event(0.1, "WARNING", [2, 1], 8),
        event(0.2, "ALERT", [2, 1], 7, sentence="from the rule"),
        event(3.0, "WARNING", [2, 1], 12),
        event(5.0, "ALERT", [2, 1], 6, sentence="from the rule"),
        event(5.1, "ALERT", [3, 1], 6),
    ]
    alerts = summarise(events)["alerts"]
    assert [a["t"] for a in alerts] == [0.0, 5.0, 5.1]
    assert alerts[0]["lead_s"] == pytest.approx(0.2), "the second pass is not the first's lead"
    assert alerts[1]["sentence"] == "from the rule"
    assert alerts[2]["lead_s"] is None
    assert alerts[2]["distance_m"] is None


def test_coasting_does_not_count_as_the_closest_approach():
    events = [event(0.0, "ALERT", [2, 1], 9), event(0.1, "ALERT", [2, 1], 1.0, lost=True)]
    assert summarise(events)["alerts"][0]["closest_m"] == 9.0


def test_text_says_what_looked_and_what_it_must_not_be_used_for():
    summary = summarise([event(0.0, "ALERT", [2, 1]), event(0.5, "ALERT", [2, 1], 4.0)])
    text = format_summary(summary)
    assert "0.5 s before the closest approach (4.0 m)" in text
    assert "detector" not in text
    text = format_summary({**summary, "detector": "small.onnx", "notice": "not for a street"})
    assert "detector: small.onnx" in text
    assert "not for a street" in text
    assert format_summary(summarise([]))


def test_the_story_passes_through_all_four_states():
    """Exact boxes, ground, tracker and rule with the shipped configuration; no pictures needed."""
    loaded = load_config(CONFIG)
    scenario = load_scenario(bundled_scenario())
    painter = ScenePainter(scenario, scene_camera(loaded, (1920, 1080)), Conditions())
    track_and_decide = TrackAndDecide(loaded)
    events = []
    for number, t in enumerate(scenario.frame_times(30).tolist()):
        found = track_and_decide.update(boxes(painter.objects(t)), 1920, 1080, t + 1e-9, 0.0)
        tracks, pair = found.tracks, found.decision.pair
        events.append(
            {
                "t": t,
                "frame": number,
                "state": found.decision.state.name,
                "pair": [pair.cyclist_id, pair.pedestrian_id] if pair else None,
                "tracks": [
                    {"id": i, "x": x, "y": y, "lost": u > 0}
                    for i, (x, y), u in zip(
                        tracks.id.tolist(),
                        tracks.xy_m.tolist(),
                        tracks.unseen_s.tolist(),
                        strict=True,
                    )
                ],
            }
        )
    summary = summarise(events)
    assert summary["state_order"] == ["IDLE", "SAFE", "WARNING", "ALERT", "WARNING"]
    assert min(summary["state_share"].values()) > 0.05
    (alert,) = summary["alerts"]
    assert alert["lead_s"] > 2.5
    assert alert["closest_m"] > 2.0, "the warned cyclist keeps clear"

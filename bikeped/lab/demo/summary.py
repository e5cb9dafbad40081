"""Summary of a replayed demo from its event lines, as JSON and as text; its scenario file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bikeped.decision.episodes import runs

#: ALERTs of one pair no farther apart than this are one alert.
MERGE_S = 1.0
_STATES = ("IDLE", "SAFE", "WARNING", "ALERT")

Event = Mapping[str, Any]


def bundled_scenario() -> Path:
    """The scenario file of the demo."""
    return Path(__file__).with_name("crossing.yaml")


def summarise(events: Sequence[Event], scenario: str = "") -> dict[str, Any]:
    """The summary of `events` (docs/messages; a header line without `state` is skipped).

    `lead_s` of an alert is the time from its first frame to the closest approach of its pair, as
    tracked: the smallest distance while both are seen, until the pair's next alert. None when the
    pair is not seen again.
    """
    frames = [event for event in events if "state" in event and "t" in event]
    count = len(frames)
    states = [str(event["state"]) for event in frames]
    alerts = [_alert(frames, first, until) for first, until in _onsets(frames)]
    return {
        "scenario": scenario,
        "frames": count,
        "duration_s": round(float(frames[-1]["t"] - frames[0]["t"]), 3) if count else 0.0,
        "state_share": {s: round(states.count(s) / max(count, 1), 4) for s in _STATES},
        "state_order": [states[first] for first, _ in runs(states)],
        "alerts": alerts,
    }


def format_summary(summary: Mapping[str, Any]) -> str:
    """The summary as a short text for a terminal."""
    title = f"Demo: {summary['scenario']}" if summary["scenario"] else "Demo"
    shares = "   ".join(
        f"{name} {100 * share:.0f} %" for name, share in summary["state_share"].items()
    )
    lines = [
        title,
        f"  {summary['duration_s']:.1f} s, {summary['frames']} frames",
        f"  {shares}",
        f"  {' > '.join(summary['state_order'])}",
        f"  alerts: {len(summary['alerts'])}",
    ]
    for alert in summary["alerts"]:
        lines.append(f"    {alert['t']:6.2f} s  {alert['sentence']}")
        if alert["lead_s"] is not None:
            lines.append(
                f"              {alert['lead_s']:.1f} s before the closest approach "
                f"({alert['closest_m']:.1f} m)"
            )
    lines += ["", f"  detector: {summary['detector']}"] if summary.get("detector") else []
    lines += [f"  {summary['notice']}"] if summary.get("notice") else []
    return "\n".join(lines) + "\n"


def _pair(event: Event) -> tuple[int, int] | None:
    pair = event.get("pair")
    return None if pair is None else (int(pair[0]), int(pair[1]))


def _onsets(frames: Sequence[Event]) -> list[tuple[int, int]]:
    """First frame of each alert, and the frame at which the same pair's next one starts."""
    onsets: list[int] = []
    last_alert: dict[tuple[int, int] | None, float] = {}
    for i, event in enumerate(frames):
        if event["state"] != "ALERT":
            continue
        pair = _pair(event)
        if float(event["t"]) - last_alert.get(pair, -math.inf) > MERGE_S:
            onsets.append(i)
        last_alert[pair] = float(event["t"])
    spans = []
    for n, first in enumerate(onsets):
        later = (i for i in onsets[n + 1 :] if _pair(frames[i]) == _pair(frames[first]))
        spans.append((first, next(later, len(frames))))
    return spans


def _alert(frames: Sequence[Event], first: int, until: int) -> dict[str, Any]:
    event = frames[first]
    pair = _pair(event)
    gaps = [
        (_distance(frames[i], pair, seen=True), float(frames[i]["t"])) for i in range(first, until)
    ]
    known = [(gap, t) for gap, t in gaps if gap is not None]
    closest, when = min(known) if known else (None, None)
    distance = _distance(event, pair, seen=False)
    return {
        "t": round(float(event["t"]), 3),
        "frame": event.get("frame"),
        "pair": list(pair) if pair else None,
        "distance_m": None if distance is None else round(distance, 2),
        "lead_s": None if when is None else round(when - float(event["t"]), 3),
        "closest_m": None if closest is None else round(closest, 2),
        "sentence": str(event.get("sentence") or _sentence(pair, distance)),
    }


def _sentence(pair: tuple[int, int] | None, distance: float | None) -> str:
    if pair is None:
        return "ALERT: a cyclist approaches a pedestrian."
    far = "" if distance is None else f", {distance:.1f} m apart"
    return f"ALERT: cyclist {pair[0]} approaches pedestrian {pair[1]}{far}."


def _distance(event: Event, pair: tuple[int, int] | None, *, seen: bool) -> float | None:
    """Distance of the pair's tracks in a frame; None when one is missing (or lost, with `seen`)."""
    if pair is None:
        return None
    at = {
        int(track["id"]): (float(track["x"]), float(track["y"]))
        for track in event.get("tracks", ())
        if not (seen and track.get("lost"))
    }
    if pair[0] not in at or pair[1] not in at:
        return None
    return math.dist(at[pair[0]], at[pair[1]])

"""A replay and a real mosquitto, which is killed in the middle and comes back."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from pathlib import Path

import jsonschema
import numpy as np
from pipeline_fakes import PATIENCE_S, FakeDetector, seen

from bikeped.capture.base import FrameSource
from bikeped.config.load import load_config
from bikeped.pipeline.replay import replay
from bikeped.types import Frame, Kind

SCHEMAS = Path(__file__).parents[2] / "docs" / "messages"
TOPICS = {"tracks", "state", "health", "availability"}


class Endless(FrameSource):
    """A recording that runs at 60 frames a second until the test has seen enough."""

    live = False

    def __init__(self, jpegs: list[bytes]) -> None:
        self.name, self.width, self.height, self.fps = "endless", 96, 64, 60.0
        self.enough = threading.Event()
        self.number = -1
        self._jpegs = jpegs
        self._started_s = time.monotonic()
        self._read = threading.Condition()

    def read(self) -> Frame | None:
        with self._read:
            self.number += 1
            self._read.notify_all()
        due_s = self._started_s + self.number / 60 - time.monotonic()
        if self.enough.wait(max(0.0, due_s)) or self.number > 60 * 60:
            return None
        jpeg = self._jpegs[self.number % len(self._jpegs)]
        return Frame(self.number, self.number / 60, 96, 64, jpeg=jpeg)

    def close(self) -> None:
        self.enough.set()

    def comes_to(self, number: int) -> None:
        """Waits until that frame was read; for a thread."""
        with self._read:
            assert self._read.wait_for(lambda: self.number >= number, PATIENCE_S)


class Walker(FakeDetector):
    """A pedestrian who is there half of the time, so that the state changes."""

    def detect(self, picture):
        there = picture.frame.number // 20 % 2 == 0
        self.answer = seen(*([(Kind.PEDESTRIAN, 48, 35)] if there else []))
        return super().detect(picture)


def check(suffix: str, payload: bytes) -> None:
    schema = json.loads((SCHEMAS / f"{suffix}.schema.json").read_text())
    message = payload.decode() if suffix == "availability" else json.loads(payload)
    jsonschema.validate(message, schema)


async def test_a_broker_killed_in_mid_replay_costs_messages_and_no_time(
    make_broker, listen, small_config, small_jpegs, tmp_path, monkeypatch
):
    broker = make_broker()
    source = Endless(small_jpegs)
    monkeypatch.setattr("bikeped.pipeline.replay.open_source", lambda *a, **k: source)
    config = small_config(
        more=f"  # of mqtt\n  enabled: true\n  host: 127.0.0.1\n  port: {broker.port}\n"
        "  site: kill\n"
        # Tracks that are lost for good at once, so that the state changes while the clip runs.
        "tracking: {max_unseen_s: 0.05}\n"
    )
    events = tmp_path / "events.jsonl"
    running = asyncio.create_task(
        asyncio.to_thread(replay, load_config(config), "endless", detector=Walker(), events=events)
    )

    def all_topics(received):
        found = {topic.rpartition("/")[2] for topic, _, _ in received}
        return found >= TOPICS or running.done()

    try:
        async with listen(broker.port, "bikeped/kill/#") as listener:
            await listener.until(all_topics)
            for topic, payload, _ in listener.received:
                check(topic.rpartition("/")[2], payload)
        await asyncio.to_thread(source.comes_to, 60)
        killed_at = source.number
        broker.kill()
        await asyncio.to_thread(source.comes_to, killed_at + 90)
        back_at = source.number
        broker.start()
        async with listen(broker.port, "bikeped/kill/#") as listener:
            await listener.until(all_topics)
            for topic, payload, _ in listener.received:
                check(topic.rpartition("/")[2], payload)
            assert not running.done()
            source.enough.set()
            await listener.until(
                lambda received: any(
                    t.endswith("/availability") and p == b"offline" for t, p, _ in received
                )
            )
            assert json.loads(listener.payloads("state")[-1])["state"] == "OFF"
    finally:
        source.enough.set()
        result = await asyncio.wait_for(running, PATIENCE_S)

    lines = [json.loads(line) for line in events.read_bytes().splitlines()[1:]]
    assert len(lines) == result.frames
    assert result.frames >= back_at  # every one was processed

    def percentiles(first: int, last: int) -> tuple[float, float]:
        total = [line["latency_ms"]["total"] for line in lines if first <= line["frame"] < last]
        assert len(total) > 10
        return float(np.percentile(total, 50)), float(np.percentile(total, 95))

    before, during = percentiles(5, killed_at), percentiles(killed_at, back_at)
    print(f"total p50, p95 in ms: {before} with the broker, {during} without")
    # A loop that waited for the broker would wait for seconds; a busy machine adds a few ms.
    assert during[0] < before[0] + 10
    assert during[1] < before[1] + 40


async def test_a_broker_that_is_not_there_changes_nothing(small_config, make_clip):
    clip = make_clip("c.avi", 20)
    loaded = load_config(small_config(clip), ["mqtt.enabled=true", "mqtt.port=9"])
    result = await asyncio.to_thread(replay, loaded, str(clip))
    assert result.frames == 20
    assert result.times.percentiles()["feedback"]["p95"] < 50

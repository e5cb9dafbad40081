"""Tells the health at its interval: to the broker, the metrics and the log."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable, Mapping

from bikeped.pipeline.loop import Loop
from bikeped.pipeline.rate_limited_log import RateLimitedLogger
from bikeped.pipeline.telemetry import Telemetry
from bikeped.telemetry.schema import HealthMessage

log = logging.getLogger(__name__)

#: A line of latencies in the log this often: enough to look back on, little enough for months.
LOG_EVERY_S = 60.0
MEASURE_EVERY_S = 1.0


async def report_health(
    telemetry: Telemetry,
    loop: Loop,
    health: Callable[[], HealthMessage],
    interval_s: float,
    light_errors: Callable[[], int] = lambda: 0,
) -> None:
    """Until cancelled. A failure here costs a message, never more."""
    limited_log = RateLimitedLogger(log)
    next_health_s = next_log_s = -math.inf
    while True:
        try:
            now_s = time.monotonic()
            telemetry.measure(loop, light_errors())
            if now_s >= next_health_s:
                next_health_s = now_s + interval_s
                message = health()
                telemetry.publish_health(message)
                if now_s >= next_log_s and message.latency_ms:
                    next_log_s = now_s + LOG_EVERY_S
                    log.info("%s", health_line(message))
        except Exception as error:  # noqa: BLE001
            limited_log.failure("health", error)
        await asyncio.sleep(min(MEASURE_EVERY_S, interval_s))


def health_line(message: HealthMessage) -> str:
    """The health in one line of the log."""
    counters = message.counters
    parts = [
        (
            f"{message.state}, {message.fps:.1f} frames/s, {counters.frames} processed, "
            f"{counters.dropped} dropped, {counters.undecodable} undecodable, "
            f"{counters.failed} failed, {counters.out_of_order} out of order"
        ),
        "latency p50/p95/p99 ms: "
        + latency_line(
            {
                stage: {"p50": row.p50, "p95": row.p95, "p99": row.p99}
                for stage, row in message.latency_ms.items()
            }
        ),
    ]
    if message.faults:
        parts.append("faults: " + "; ".join(message.faults))
    return "health: " + " | ".join(parts)


def latency_line(percentiles: Mapping[str, Mapping[str, float]]) -> str:
    """`acquire 0.5/1.2/1.9, pre ...`: p50, p95 and p99 of each stage."""
    return ", ".join(
        f"{stage} {row['p50']:.1f}/{row['p95']:.1f}/{row['p99']:.1f}"
        for stage, row in percentiles.items()
    )

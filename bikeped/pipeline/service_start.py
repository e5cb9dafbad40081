"""How the service starts on a pole: on the last good configuration where the new one is broken,
and ever later, without green, where it keeps ending soon after its start."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from bikeped.config.last_good import LastGood, load_runnable
from bikeped.config.load import LoadedConfig
from bikeped.errors import BikepedError
from bikeped.faults import Fault
from bikeped.files import WholeFile, make_folder, read_regular, write_synced
from bikeped.types import Signal

log = logging.getLogger(__name__)

#: FAULT is shown this long before a last good configuration runs in place of a broken one.
BROKEN_FAULT_S = 5.0
#: A configuration is kept once the light has not shown FAULT for this long.
WELL_S = 5.0
#: A service that has run this long has not ended soon after its start.
STEADY_S = 60.0
#: After an early end blue and green are withheld this long.
WITHHOLD_S = 10.0
#: So many early ends in a row cost no pause; then 2 s, 4 s and so on, at most PAUSE_MAX_S.
_FREE_ENDS, PAUSE_MAX_S = 2, 60.0
_POLL_S = 0.25


def pause_s(early_ends: int) -> float:
    """How long FAULT is shown before anything is loaded, after so many early ends in a row."""
    return min(PAUSE_MAX_S, 2.0 ** (early_ends - _FREE_ENDS)) if early_ends > _FREE_ENDS else 0.0


class EarlyEnds:
    """Counts starts in a row that ended by themselves within STEADY_S, in a file.

    Needs no clock, which may be wrong after a loss of power: a start counts until it has `settled`.
    A file that cannot be read or written counts as 0, with a warning: it is no reason not to run.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def begin(self) -> int:
        """The number of early ends before this start, which counts as one from now on."""
        number = 0
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
            number = max(0, int(json.loads(read_regular(self._path))["early_ends"]))
        self._write(number + 1)
        return number

    def settle(self) -> None:
        """This start is no early end."""
        self._write(0)

    def _write(self, number: int) -> None:
        try:
            with WholeFile(self._path) as partial_path:
                write_synced(partial_path, json.dumps({"early_ends": number}).encode())
        except OSError as error:
            log.warning("%s: cannot be written (%s)", self._path, error.strerror)


@dataclass(frozen=True)
class ServiceStart:
    """What is special about one start of the service; by default nothing."""

    fault_s: float = 0.0  #: FAULT this long, before anything is loaded
    reason: Fault | None = None  #: what it shows then
    withhold_s: float = 0.0  #: blue and green are withheld this long once the service is ready
    notice: Fault | None = None  #: in health as long as the service runs
    on_well: Callable[[], None] | None = None  #: called once after WELL_S without FAULT
    on_steady: Callable[[], None] | None = None  #: called after STEADY_S, or at an orderly end

    def fault_sources(self) -> tuple[Callable[[], Fault | None], ...]:
        """For the fault monitor, from the moment at which the service is ready."""
        until_s = time.monotonic() + self.withhold_s
        unsteady = Fault("service", "service.unsteady", "it ended soon after its start before")
        return (lambda: self.notice, lambda: unsteady if time.monotonic() < until_s else None)

    async def watch(self, shown: Callable[[], Signal | None]) -> None:
        """Calls `on_well` and `on_steady` when they are due; `shown` is the light's signal."""
        began_s = well_since_s = time.monotonic()
        on_well, on_steady = self.on_well, self.on_steady
        while on_well is not None or on_steady is not None:
            await asyncio.sleep(_POLL_S)
            now_s, signal = time.monotonic(), shown()
            if signal is None or signal.name == "FAULT":
                well_since_s = now_s
            if on_well is not None and now_s - well_since_s >= WELL_S:
                await asyncio.to_thread(on_well)
                on_well = None
            if on_steady is not None and now_s - began_s >= STEADY_S:
                await asyncio.to_thread(on_steady)
                on_steady = None


PLAIN_START = ServiceStart()


def start_on_pole(
    path: Path,
    overrides: Sequence[str],
    folder: Path,
    serve: Callable[[LoadedConfig, ServiceStart], int],
) -> int:
    """Runs `serve` with the configuration at `path`, or else with the copy in `folder`.

    Returns its exit status. Raises BikepedError where neither can be used.
    """
    try:
        make_folder(folder, "--last-good")
    except BikepedError as error:
        log.warning("%s", error)
    last_good, ends = LastGood(folder), EarlyEnds(folder / "starts.json")
    number = ends.begin()
    copy = last_good.load(path, overrides)
    loaded = None
    try:
        loaded = load_runnable(path, overrides, copy)
        return serve(loaded, _start(number, ends, partial(_keep, last_good, loaded)))
    except BikepedError as error:
        if copy is None or (loaded is not None and loaded.hash == copy.hash):
            raise
        problem = " ".join(str(error).split())
    log.error("%s; running on the last good configuration, %s", problem, copy.source)
    return serve(copy, _start(number, ends, None, problem))


def _start(
    number: int, ends: EarlyEnds, keep: Callable[[], None] | None, problem: str | None = None
) -> ServiceStart:
    fault_s, reason, notice = pause_s(number), None, None
    if number:
        log.warning("%d starts in a row ended early; FAULT for %g s at first", number, fault_s)
        reason = Fault("service", "service.unsteady", "it ended soon after its start before")
    if problem is not None:
        notice = Fault(
            "configuration", "service.last_good_config", f"the last good one runs: {problem}"
        )
        fault_s, reason = max(fault_s, BROKEN_FAULT_S), notice
    return ServiceStart(
        fault_s=fault_s,
        reason=reason,
        withhold_s=WITHHOLD_S if number else 0.0,
        notice=notice,
        on_well=keep,
        on_steady=ends.settle,
    )


def _keep(last_good: LastGood, loaded: LoadedConfig) -> None:
    try:
        last_good.keep(loaded)
    except OSError as error:
        log.warning("%s: cannot be kept (%s)", last_good.folder, error.strerror)
    else:
        log.info("configuration %s runs well: kept in %s", loaded.hash[:12], last_good.folder)

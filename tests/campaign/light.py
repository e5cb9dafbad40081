"""The light's timeline, read from outside: (monotonic seconds, colour) of every change."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Collection
from pathlib import Path

REASSURING = ("green", "blue")
#: In the order in which one is named when several are lit.
COLOURS = ("green", "blue", "red", "orange")


class LightTimeline:
    """Reads the file that the light writes its changes to (see `campaign.launch`)."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def changes(self) -> list[tuple[float, str]]:
        """All changes so far, in order."""
        if not self.path.exists():
            return []
        lines = self.path.read_text().split("\n")[:-1]  # the last one may not be whole yet
        return [(float(time_s), colour) for time_s, colour in map(str.split, lines)]

    def colour(self) -> str:
        """The colour now."""
        changes = self.changes()
        return changes[-1][1] if changes else "off"

    def until(self, colours: Collection[str], since_s: float, timeout_s: float) -> float:
        """Seconds from `since_s` until one of `colours` shows; infinite after `timeout_s`.

        What shows at `since_s` counts: the answer is 0 then.
        """
        deadline_s = max(time.monotonic(), since_s) + timeout_s
        while True:
            before = "off"
            for at_s, colour in self.changes():
                if at_s < since_s:
                    before = colour
                elif before in colours:
                    return 0.0
                elif colour in colours:
                    return at_s - since_s
            if before in colours:
                return 0.0
            if time.monotonic() > deadline_s:
                return math.inf
            time.sleep(0.01)

    def reassured_s(self, from_s: float, to_s: float) -> float:
        """Seconds of green or blue between two times."""
        total, changes = 0.0, [*self.changes(), (math.inf, "off")]
        for (at_s, colour), (next_s, _) in itertools.pairwise(changes):
            if colour in REASSURING:
                total += max(0.0, min(next_s, to_s) - max(at_s, from_s))
        return total

    def count(self, colours: Collection[str], from_s: float, to_s: float) -> int:
        """How often one of `colours` began to show between two times."""
        return sum(colour in colours and from_s <= at_s <= to_s for at_s, colour in self.changes())


class FileWatch:
    """Notes the changes of the lamp process's file with their times, for `LightTimeline`."""

    def __init__(self, state: Path, timeline: Path) -> None:
        self._state, self._timeline = state, timeline
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        before = ""
        with self._timeline.open("a") as timeline:
            while not self._ends.wait(0.004):
                try:
                    lit = self._state.read_text().split()
                except (OSError, IndexError):
                    continue
                colour = next((name for name in COLOURS if name in lit), "off")
                if colour != before:
                    timeline.write(f"{time.monotonic():.4f} {colour}\n")
                    timeline.flush()
                    before = colour

    def close(self) -> None:
        self._ends.set()
        self._thread.join()

"""The figures: every one measured beside the obvious way of doing the same, in one run.

`scripts/bench` runs all, `scripts/bench table nms` some; `--json FILE` keeps the figures. Ours and
the obvious way take turns (A B A B ...), so that a machine that changes its speed changes both; the
median of each and the median of the ratios are shown. Nothing here is asserted: the tests hold
what must hold, this shows how fast it is.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

# The obvious ways would otherwise spread over both cores and hide what they cost.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parent))

from benchmarks.figures import Figures


def main() -> int:
    from benchmarks import (
        calibration,
        conformance,
        detection,
        loop,
        monitor,
        scene,
        table,
        testbench,
        tracking,
    )

    known: dict[str, Callable[[Figures], None]] = {
        "table": table.run,
        "frame": detection.frame,
        "nms": detection.nms,
        "tracking": tracking.run,
        "loop": loop.run,
        "bundled": loop.bundled,
        "monitor": monitor.run,
        "conformance": conformance.run,
        "scene": scene.run,
        "calibration": calibration.run,
        "calibration-large": calibration.large,
        "testbench": testbench.run,
    }
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="BENCHMARK", help=", ".join(known))
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in known]
    if unknown:
        parser.error(f"unknown benchmark {unknown[0]}; known are {', '.join(known)}")
    figures = Figures()
    print(f"{'what':<62}{'ours':>12}{'obvious':>12}{'ratio':>8}  {'unit':<9}goal")
    for name in arguments.names or known:
        known[name](figures)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures.rows, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

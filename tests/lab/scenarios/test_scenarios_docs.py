"""docs/scenarios.md describes the 24 scenario files.

`python tests/lab/scenarios/test_scenarios_docs.py` writes it.
"""

import sys
from collections import Counter
from pathlib import Path

from bikeped.lab.scenarios.scenario import HAZARDS, bundled_folder, load_scenarios
from bikeped.lab.simulation.simulate import FPS
from bikeped.lab.simulation.truth import compute_ground_truth

PAGE = Path(__file__).parents[3] / "docs" / "scenarios.md"
FOLDER = "../bikeped/lab/scenarios/bundled"
STREET_FOLDER = "../bikeped/lab/scenarios/street"
INTRO = """\
# The 24 scenarios

<!-- Written by `python tests/lab/scenarios/test_scenarios_docs.py`; a test compares. -->

The suite of the conformance simulation: one file a scenario, in
[bikeped/lab/scenarios/bundled]({folder}).
They are conformance cases: kinds of encounter that the system must handle, not a statistical
sample of traffic; none is a recorded event. The world is a plan in metres, x east and y north; the
crosswalk lies along x = 5, the camera stands at (5, -13) and looks north. Pedestrians walk at 1.0
to 1.6 m/s (a child 0.9, a wheelchair 0.6, one runner 2.5), cyclists ride at 3 to 8 m/s, e-bikes
and e-scooters at 6 to 12.5.

Danger frames are those with danger in the kinematic ground truth (30 a second); of these the
actionable ones leave a distracted pedestrian time to react (TTC of at least 1.87 s).
{danger} of the {count} scenarios hold danger, {actionable} actionable danger: Fast Approach and
Occluded Emergence are over too soon for any warning. `--scenarios DIR` on every conformance command
runs your own files instead.
"""
STREET = """\
## An ordinary street

`--scenarios street` runs these instead, from
[bikeped/lab/scenarios/street](../bikeped/lab/scenarios/street): what recorded traffic is full of
and the 24 lack. In most of them nothing happens, and a light that is red then is what people stop
believing. An agent may be `hidden` in spans of time (something stands in the camera's way), and
`duration_s` lets a scenario run on after the last waypoint, so that what a tracker makes of
somebody it has lost is seen.

"""
SWERVE = """\
**Swerving Cyclist** shows a limit of the rule, on purpose: while the cyclist cuts in, the way
gained ahead hides the way lost to the side, the distance stops shrinking, and the alert of the
swerve begins at the closest approach, with no time left.
"""


def page(scenarios, street):
    truths = {s.name: compute_ground_truth(s) for s in scenarios}
    intro = INTRO.format(
        folder=FOLDER,
        count=len(scenarios),
        danger=sum(t.danger.any() for t in truths.values()),
        actionable=sum(t.actionable.any() for t in truths.values()),
    )
    return "\n".join(
        [intro, table(scenarios, FOLDER), SWERVE, STREET + table(street, STREET_FOLDER)]
    )


def table(scenarios, folder):
    lines = [
        "| scenario | hazard | story | seconds | agents | danger frames | actionable |",
        "| --- | --- | --- | ---: | --- | ---: | ---: |",
    ]
    for s in sorted(scenarios, key=lambda s: (HAZARDS.index(s.hazard), s.name)):
        truth = compute_ground_truth(s)
        seconds = len(truth.time_s) / FPS
        lines.append(
            f"| [{s.name}]({folder}/{Path(s.source).name}) | {s.hazard} | {s.story} | "
            f"{seconds:.1f} | {agents(s)} | {truth.danger.sum()} | {truth.actionable.sum()} |"
        )
    return "\n".join(lines) + "\n"


def agents(scenario):
    counts = Counter(a.kind for a in scenario.agents)
    words = [f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items()]
    return ", ".join(words) + (" (e-bike braking)" if scenario.vehicle == "ebike" else "")


def test_the_page_is_current(suite):
    remedy = "run: python tests/lab/scenarios/test_scenarios_docs.py"
    assert PAGE.read_text(encoding="utf-8") == page(
        suite.scenarios, load_scenarios(Path("street"))
    ), remedy


if __name__ == "__main__":
    both = load_scenarios(bundled_folder()), load_scenarios(Path("street"))
    PAGE.write_text(page(*both), encoding="utf-8")
    sys.stdout.write(f"{PAGE}\n")

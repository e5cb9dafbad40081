"""A small street as traffic files: the waypoints of scenarios, as CSV or as SUMO writes them."""

import gzip
import json

from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.perception import SIMULATION_POSE

BUNDLED = {s.name: s for s in load_scenarios(bundled_folder())}
NAMES = ("Swerving Cyclist", "Safe Crossing")
POLE = {"x_m": SIMULATION_POSE.x_m, "y_m": SIMULATION_POSE.y_m, "heading_deg": 90}


def csv_text(scenario):
    rows = [
        f"{t!r},{agent.id},{agent.kind},{x!r},{y!r}"
        for agent in scenario.agents
        for t, x, y in agent.path.tolist()
    ]
    return "\n".join(["time_s,id,kind,x_m,y_m", *rows]) + "\n"


def xml_text(scenario):
    """The same as `sumo --fcd-output` writes it: by time, with types of vehicles."""
    steps = {}
    for agent in scenario.agents:
        for t, x, y in agent.path.tolist():
            place = f'id="{agent.id}" x="{x!r}" y="{y!r}"'
            line = f'<vehicle {place} angle="90" type="{agent.kind}" speed="1.0"/>'
            if agent.kind == "pedestrian":
                line = f'<person {place} angle="90" speed="1.0"/>'
            elif agent.kind == "cyclist":
                line = line.replace("cyclist", "DEFAULT_BIKETYPE")
            steps.setdefault(t, []).append(line)
    lines = [f'<timestep time="{t!r}">{"".join(found)}</timestep>' for t, found in steps.items()]
    return "<fcd-export>" + "".join(lines) + "</fcd-export>"


def write_traffic(folder, names=NAMES):
    """A folder of traffic: each of the bundled scenarios, as CSV and packed."""
    poles = {}
    for name in names:
        scene = name.lower().replace(" ", "-")
        poles[scene] = POLE
        (folder / f"{scene}.csv.gz").write_bytes(gzip.compress(csv_text(BUNDLED[name]).encode()))
    (folder / "poles.json").write_text(json.dumps(poles))
    return folder

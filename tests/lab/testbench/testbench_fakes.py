"""A test bench behind an application, and how tests ask it."""

from __future__ import annotations

import json
import urllib.request
from typing import Any

import msgspec
from web_fakes import OPEN

from bikeped.config.load import load_config
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.testbench.pages import add_testbench
from bikeped.lab.testbench.settings import BenchSettings, settings_in_force
from bikeped.web.server import make_application

LOADED = load_config()
SCENARIOS = load_scenarios(bundled_folder())
BASE = settings_in_force(LOADED)
MARKUP = "<img src=x onerror=document.title='hacked'><b>&amp;"
OWN = """
name: My crossing
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -8.0], [9.0, 5.0, 4.0]]}
  - {id: 2, kind: cyclist, path: [[0.5, -13.0, -2.0], [9.0, 32.0, -2.0]]}
"""


def pages():
    """The application."""
    return make_application(OPEN, lambda app: add_testbench(app, LOADED, SCENARIOS))


def bench(
    scenario: str = "", base: BenchSettings = BASE, **sections: dict[str, Any]
) -> BenchSettings:
    """`base` with changed keys: `bench(decision={"d_max_m": 9.0})`."""
    changes: dict[str, Any] = {
        name: msgspec.structs.replace(getattr(base, name), **keys)
        for name, keys in sections.items()
    }
    return msgspec.structs.replace(base, scenario=scenario, **changes)


def post(url: str, path: str, data: Any) -> Any:
    """The JSON of a POST; HTTPError where it is refused."""
    request = urllib.request.Request(
        url + path, msgspec.json.encode(data), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)

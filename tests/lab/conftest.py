"""The 24 scenarios before the deployed camera, made once."""

from pathlib import Path

import pytest

from bikeped.config.load import load_config
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.suite import Suite

CONFIG = Path(__file__).parents[2] / "config.yaml"


@pytest.fixture(scope="session")
def suite():
    return Suite.load(load_scenarios(bundled_folder()), load_config(CONFIG))

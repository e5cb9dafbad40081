"""Eight recorded scenes of a campus: what was measured on them by other means comes out again.

They lie beside the project and may not be copied into it.
"""

from pathlib import Path

import pytest
import shared_inputs

from bikeped.config.load import load_config
from bikeped.lab.simulation.light_record import hours_both_in_view, light_figures
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.lab.traffic.readers import read_traffic
from bikeped.lab.traffic.suite import TrafficSuite

TRAFFIC = shared_inputs.SHARED / "traffic"
WHY = shared_inputs.missing(TRAFFIC / "poles.json", TRAFFIC / "nexus-video10.csv.gz")
pytestmark = pytest.mark.skipif(bool(WHY), reason=WHY)
SELECTED = CONFIGURATIONS["selected"]


@pytest.fixture(scope="module")
def suite():
    loaded = load_config(Path(__file__).parents[3] / "config.yaml")
    return TrafficSuite.load(read_traffic(TRAFFIC), loaded, "realistic", 0)


def test_foresight_is_as_red_as_the_definitions_say(suite):
    """Section 16: 124 alerts an hour and 17.0 % red, at a hold of 1.5 s."""
    lights = suite.foresight(SELECTED)
    found = light_figures(lights)
    assert found["alerts_per_hour"] == pytest.approx(124, abs=0.5)
    assert found["red_share"] == pytest.approx(0.170, abs=0.0005)
    assert found["alerts_with_danger"] == 1
    assert hours_both_in_view(lights) == pytest.approx(0.110, abs=0.001)
    assert found["fair_conflicts"] == 16


def test_the_papers_rule_is_as_it_was_measured(suite):
    """Section 16: 127 alerts an hour, 71 % with danger, 29.4 % red; the tracker is another now."""
    found = light_figures(suite.lights(SELECTED))
    assert found["alerts_per_hour"] == pytest.approx(127, rel=0.1)
    assert found["alerts_with_danger"] == pytest.approx(0.71, abs=0.06)
    assert found["red_share"] == pytest.approx(0.294, abs=0.02)
    assert found["fair_missed"] == 0

"""Home Assistant's discovery: what its documentation demands; templates find their keys."""

from __future__ import annotations

import json
import re
from typing import get_args

import msgspec
import pytest

from bikeped.config.output_sections import MqttConfig
from bikeped.telemetry.homeassistant import discovery_messages, object_id
from bikeped.telemetry.schema import HealthMessage, ShownState, StageLatency, StateMessage

TOPIC = re.compile(r"^homeassistant/(sensor|binary_sensor)/([a-zA-Z0-9_-]+)/config$")
TYPES = {"state": StateMessage, "health": HealthMessage}


def entities(site: str = "north") -> dict[str, dict]:
    config = MqttConfig(site=site, home_assistant=True)
    return {
        topic: json.loads(payload) for topic, payload in discovery_messages(config, "1.2").items()
    }


@pytest.mark.parametrize("site", ["north", "Große Kreuzung", "a b", "x.y:z"])
def test_topics_and_identity(site: str):
    announced = entities(site)
    assert len(announced) == 5
    for topic, entity in announced.items():
        match = TOPIC.match(topic)
        assert match, topic
        assert entity["unique_id"] == match[2]
        assert entity["availability_topic"] == f"bikeped/{site}/availability"
        assert entity["state_topic"].startswith(f"bikeped/{site}/")
        assert entity["device"]["identifiers"] == [object_id(site)]
        assert entity["origin"]["name"] == "bikeped"
    assert len({entity["unique_id"] for entity in announced.values()}) == 5


def test_sites_that_look_alike_stay_apart():
    assert len({object_id("a b"), object_id("a.b"), object_id("a_b")}) == 3


def test_the_state_is_an_enum_with_every_state_and_neither_unit_nor_state_class():
    state = entities()["homeassistant/sensor/bikeped_north_state/config"]
    assert state["device_class"] == "enum"
    assert set(state["options"]) == set(get_args(ShownState))
    assert not {"unit_of_measurement", "state_class"} & state.keys()


def test_the_problem_is_a_binary_sensor_of_class_problem():
    problem = entities()["homeassistant/binary_sensor/bikeped_north_problem/config"]
    assert problem["device_class"] == "problem"
    assert (problem["payload_on"], problem["payload_off"]) == ("ON", "OFF")
    assert "'ON' if value_json.faults else 'OFF'" in problem["value_template"]


def test_templates_name_keys_that_the_messages_have():
    for entity in entities().values():
        message = TYPES[entity["state_topic"].rpartition("/")[2]]
        keys = {field.encode_name for field in msgspec.structs.fields(message)}
        paths = re.findall(r"value_json((?:\.\w+)+)", entity["value_template"])
        assert paths
        for path in paths:
            first, *rest = path[1:].split(".")
            assert first in keys
            if rest[1:]:
                percentiles = {f.encode_name for f in msgspec.structs.fields(StageLatency)}
                assert rest[0] == "total"
                assert rest[1] in percentiles
        assert entity["value_template"].count("{{") == entity["value_template"].count("}}") == 1


@pytest.mark.parametrize(
    ("interval_s", "expire_after"), [(0.1, 30), (10.0, 30), (10.5, 32), (11.0, 33), (100.0, 300)]
)
def test_health_values_expire_after_three_missed_reports_and_30_s_at_least(
    interval_s: float, expire_after: int
):
    config = MqttConfig(home_assistant=True, health_interval_s=interval_s)
    found = [json.loads(payload) for payload in discovery_messages(config, "1").values()]
    on_health = [entity for entity in found if entity["state_topic"].endswith("/health")]
    assert [entity.get("expire_after") for entity in on_health] == [expire_after] * 4
    # A state may last for hours.
    assert all("expire_after" not in entity for entity in found if entity not in on_health)

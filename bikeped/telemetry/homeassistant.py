"""Home Assistant's MQTT discovery: one retained message an entity. Pure.

Follows https://www.home-assistant.io/integrations/mqtt/#mqtt-discovery: the topic is
`<prefix>/<component>/<object_id>/config` with an object id equal to the unique id; an `enum` sensor
lists its options and has neither unit nor state class; `None` means unknown. One message an
entity, not one a device: old versions understand only that.
"""

from __future__ import annotations

import hashlib
import re
from typing import Any, get_args

import msgspec

from bikeped.config.output_sections import MqttConfig
from bikeped.telemetry.schema import ShownState


def discovery_messages(config: MqttConfig, version: str) -> dict[str, bytes]:
    """Topic -> payload of every entity, to be published retained.

    An empty retained payload on one of these topics removes its entity again.
    """
    base = f"bikeped/{config.site}"
    pole = object_id(config.site)
    shared = {
        "availability_topic": f"{base}/availability",
        "device": {
            "identifiers": [pole],
            "name": f"bikeped {config.site}",
            "manufacturer": "bikeped",
            "model": "crossing warning light",
            "sw_version": version,
        },
        "origin": {"name": "bikeped", "sw_version": version},
        "qos": config.qos,
    }
    # A process that hangs keeps its connection for a while; three missed reports show it earlier.
    health = {
        "state_topic": f"{base}/health",
        "expire_after": max(30, round(3 * config.health_interval_s)),
        "entity_category": "diagnostic",
    }
    measurement = {**health, "state_class": "measurement"}
    entities: dict[tuple[str, str], dict[str, Any]] = {
        ("sensor", "state"): {
            "name": "State",
            "icon": "mdi:traffic-light",
            "device_class": "enum",
            "options": list(get_args(ShownState)),
            "state_topic": f"{base}/state",
            "value_template": "{{ value_json.state }}",
            "json_attributes_topic": f"{base}/state",
        },
        ("binary_sensor", "problem"): {
            **health,
            "name": "Problem",
            "device_class": "problem",
            "payload_on": "ON",
            "payload_off": "OFF",
            "value_template": "{{ 'ON' if value_json.faults else 'OFF' }}",
            "json_attributes_topic": f"{base}/health",
            "json_attributes_template": "{{ {'faults': value_json.faults} | tojson }}",
        },
        ("sensor", "fps"): {
            **measurement,
            "name": "Frame rate",
            "icon": "mdi:speedometer",
            "unit_of_measurement": "fps",
            "value_template": "{{ value_json.fps }}",
        },
    }
    for percentile in ("p50", "p95"):
        entities["sensor", f"latency_{percentile}"] = {
            **measurement,
            "name": f"Latency {percentile}",
            "device_class": "duration",
            "unit_of_measurement": "ms",
            "value_template": "{{ value_json.latency_ms.total."
            f"{percentile} if 'total' in value_json.latency_ms else none }}}}",
        }
    return {
        f"{config.discovery_prefix}/{component}/{pole}_{name}/config": msgspec.json.encode(
            {**entity, "unique_id": f"{pole}_{name}", **shared}
        )
        for (component, name), entity in entities.items()
    }


def object_id(site: str) -> str:
    """An id for `site` of the characters that Home Assistant allows: [a-zA-Z0-9_-].

    Where some had to be replaced, a digest keeps similar sites apart.
    """
    plain = re.sub(r"[^a-zA-Z0-9_-]", "_", site)
    if plain == site:
        return f"bikeped_{plain}"
    return f"bikeped_{plain}_{hashlib.sha256(site.encode()).hexdigest()[:8]}"

"""The one place that knows every stage: from a frame to the light, the bell and MQTT."""

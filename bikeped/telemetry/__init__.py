"""Telemetry: MQTT messages, event files, the audit log, metrics and health over HTTP.

Nothing here may delay or stop the decision: what cannot be delivered is dropped and counted.
"""

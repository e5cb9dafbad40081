"""What bikeped tells the outside: MQTT messages, event lines, metrics, health over HTTP.

`messages` builds every payload and is pure; `schemas` writes their JSON Schemas; `mqtt` publishes
them, with credentials from `mqtt_auth` and Home Assistant's announcements from `homeassistant`;
`latency` and `metrics` keep the numbers; `events` and `audit` write event lines to files; `http`
serves `/metrics` and `/healthz`. Nothing here may delay or stop the decision: what cannot be
delivered is dropped and counted. Import from the modules; this one imports none of them.
"""

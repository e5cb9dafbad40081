"""What bikeped tells the outside: MQTT messages, event lines, metrics, health over HTTP.

`messages` builds every payload and event line, pure; `shapes` says what they look like, and
`schemas` says it as JSON Schema; `mqtt` publishes, with credentials from `mqtt_auth` and Home
Assistant's announcements from `homeassistant`; `events` and `audit` write event lines to files;
`latency` and `metrics` keep the numbers; `http` serves `/metrics` and `/healthz`. Nothing here may
delay or stop the decision: what cannot be delivered is dropped and counted. Import from the
modules; this one imports none of them.
"""

"""Keys of what the box says: light, sound, MQTT, HTTP and the audit log."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bikeped.config.schema.base import Section

Ratio = Annotated[float, Meta(ge=0, le=1)]
Line = Annotated[str, Meta(min_length=1)] | Annotated[int, Meta(ge=0, le=4095)]


class GpioConfig(Section, frozen=True):
    """A light on GPIO lines."""

    chip: Annotated[
        str, Meta(min_length=1, description="chip by label, name or path, e.g. tegra234-gpio")
    ] = "tegra234-gpio"
    red: Annotated[Line | None, Meta(description="line name or offset; null: not wired")] = None
    orange: Annotated[Line | None, Meta(description="line name or offset; null: not wired")] = None
    green: Annotated[Line | None, Meta(description="line name or offset; null: not wired")] = None
    blue: Annotated[Line | None, Meta(description="line name or offset; null: not wired")] = None
    active_low: Annotated[bool, Meta(description="a low line lights the lamp")] = False


class UsbConfig(Section, frozen=True):
    """A USB light or relay board."""

    device: Annotated[
        Literal["blink1", "luxafor", "relay"],
        Meta(
            description="blink1: ThingM blink(1); luxafor: Luxafor Flag; relay: HID relay board "
            "16c0:05df, one relay a colour"
        ),
    ] = "relay"
    serial: Annotated[
        str | None, Meta(description="serial number when several are plugged in; null: first")
    ] = None
    relay_red: Annotated[int, Meta(ge=0, le=8, description="relay of red; 0: not wired")] = 1
    relay_orange: Annotated[int, Meta(ge=0, le=8, description="relay of orange; 0: not wired")] = 2
    relay_green: Annotated[int, Meta(ge=0, le=8, description="relay of green; 0: not wired")] = 3
    relay_blue: Annotated[int, Meta(ge=0, le=8, description="relay of blue; 0: not wired")] = 4


class SoundConfig(Section, frozen=True):
    """The speaker."""

    enabled: Annotated[bool, Meta(description="play chime and bell")] = False
    device: Annotated[str, Meta(min_length=1, description="ALSA device, as aplay -D takes it")] = (
        "default"
    )
    volume: Annotated[Ratio, Meta(description="0 is silent, 1 is full scale")] = 0.8
    chime: Annotated[str | None, Meta(description="WAV file of the chime; null: bikeped's own")] = (
        None
    )
    bell: Annotated[str | None, Meta(description="WAV file of the bell; null: bikeped's own")] = (
        None
    )
    chime_cooldown_s: Annotated[
        float, Meta(ge=0, le=3600, description="shortest time between two chimes, seconds")
    ] = 5.0
    bell_cooldown_s: Annotated[
        float,
        Meta(
            ge=0,
            le=3600,
            description="shortest time between two bells; while ALERT lasts the bell repeats, s",
        ),
    ] = 1.5


class FeedbackConfig(Section, frozen=True):
    """The light and the speaker."""

    light: Annotated[
        Literal["simulated", "gpio", "usb"],
        Meta(description="simulated writes to the log"),
    ] = "simulated"
    blink_hz: Annotated[
        float, Meta(gt=0, le=10, description="blinking of ALERT's red, flashes per second")
    ] = 2.0
    fault_blink_hz: Annotated[
        float,
        Meta(gt=0, le=10, description="blinking of FAULT's orange, flashes per second"),
    ] = 0.5
    hold_alert_s: Annotated[
        float,
        Meta(
            ge=0,
            le=10,
            description="the light keeps ALERT at least this long, so that one frame is seen, s",
        ),
    ] = 1.0
    recover_frames: Annotated[
        int,
        Meta(ge=1, le=300, description="good frames in a row before the light leaves FAULT"),
    ] = 5
    gpio: GpioConfig = msgspec.field(default_factory=GpioConfig)
    usb: UsbConfig = msgspec.field(default_factory=UsbConfig)
    sound: SoundConfig = msgspec.field(default_factory=SoundConfig)


class MqttConfig(Section, frozen=True):
    """Telemetry."""

    enabled: Annotated[bool, Meta(description="publish to the broker")] = False
    host: Annotated[str, Meta(min_length=1, description="broker's name or address")] = "localhost"
    port: Annotated[int, Meta(ge=1, le=65535, description="broker's port")] = 1883
    site: Annotated[
        str,
        Meta(
            pattern="^[^/+#\\x00]+$",
            max_length=64,
            description="the <site> of the topics bikeped/<site>/...",
        ),
    ] = "crossing"
    qos: Annotated[int, Meta(ge=0, le=2, description="quality of service of state and health")] = 1
    publish_interval_s: Annotated[
        float, Meta(ge=0.01, le=3600, description="time between two track messages, seconds")
    ] = 0.1
    health_interval_s: Annotated[
        float, Meta(ge=0.1, le=3600, description="time between two health messages, seconds")
    ] = 10.0
    keepalive_s: Annotated[int, Meta(ge=1, le=3600, description="MQTT keep-alive, seconds")] = 15
    username: Annotated[str | None, Meta(description="user name; null: none")] = None
    password_file: Annotated[
        str | None, Meta(description="file whose first line is the password; null: none")
    ] = None
    tls: Annotated[bool, Meta(description="encrypt the connection")] = False
    ca_file: Annotated[str | None, Meta(description="CA certificates; null: the system's")] = None
    cert_file: Annotated[str | None, Meta(description="client certificate; null: none")] = None
    key_file: Annotated[str | None, Meta(description="key of the client certificate")] = None
    home_assistant: Annotated[
        bool, Meta(description="announce the entities for Home Assistant's discovery")
    ] = False
    discovery_prefix: Annotated[
        str, Meta(min_length=1, description="Home Assistant's discovery prefix")
    ] = "homeassistant"


def is_loopback(host: str) -> bool:
    """Whether `host`, a name or an address, is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class WebConfig(Section, frozen=True):
    """The HTTP server: the pages for people, `/metrics` and `/healthz`."""

    enabled: Annotated[bool, Meta(description="serve the pages, /metrics and /healthz")] = False
    host: Annotated[
        str,
        Meta(
            min_length=1,
            description="address to bind; any but this machine's own (127.0.0.1, ::1, localhost) "
            "needs web.token_file",
        ),
    ] = "127.0.0.1"
    port: Annotated[int, Meta(ge=0, le=65535, description="port to bind; 0: any free one")] = 8080
    token_file: Annotated[
        str | None,
        Meta(
            description="file whose first line is the token or password, 12 characters or more, "
            "that everything but the login page asks for; null: none"
        ),
    ] = None
    allowed_hosts: Annotated[
        tuple[str, ...],
        Meta(
            max_length=32,
            description="further names under which browsers may open the pages, e.g. pole7.lan",
        ),
    ] = ()
    max_connections: Annotated[
        int, Meta(ge=4, le=1000, description="open connections; more are turned away")
    ] = 64
    max_viewers: Annotated[
        int, Meta(ge=1, le=100, description="live pages at a time; more are turned away")
    ] = 8
    stream_fps: Annotated[
        float,
        Meta(gt=0, le=30, description="pictures per second of the live page, while someone looks"),
    ] = 10.0
    stream_width: Annotated[
        int, Meta(ge=160, le=3840, description="width of the live page's picture, pixels")
    ] = 960


class AuditConfig(Section, frozen=True):
    """The audit log: one JSON line a frame."""

    path: Annotated[str | None, Meta(description="file to append to; null writes no audit log")] = (
        None
    )
    max_mb: Annotated[
        float, Meta(ge=0.01, le=100000, description="size at which the file is rotated, MB")
    ] = 100.0
    keep: Annotated[int, Meta(ge=1, le=1000, description="rotated files that are kept")] = 10
    min_free_mb: Annotated[
        float,
        Meta(ge=0, le=1000000, description="nothing is written with less free disk than this, MB"),
    ] = 500.0

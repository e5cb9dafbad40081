"""Keys of the sections for what leaves the device: light, sound, messages, pages, audit log.

As in `schema`, the text below a key goes into the page of all keys.
"""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Ratio = Annotated[float, Meta(ge=0, le=1)]
Line = Annotated[str, Meta(min_length=1)] | Annotated[int, Meta(ge=0, le=4095)]


class Section(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=False
):
    """Base of all sections: immutable, no unknown keys."""


class GpioConfig(Section, frozen=True):
    """A light on GPIO lines."""

    chip: Annotated[str, Meta(min_length=1)] = "tegra234-gpio"
    """chip by label, name or path, e.g. tegra234-gpio"""
    red: Line | None = None
    """line name or offset; null: not wired"""
    orange: Line | None = None
    """line name or offset; null: not wired"""
    green: Line | None = None
    """line name or offset; null: not wired"""
    blue: Line | None = None
    """line name or offset; null: not wired"""
    active_low: bool = False
    """a low line lights the lamp"""


class UsbConfig(Section, frozen=True):
    """A USB light or relay board."""

    device: Literal["blink1", "luxafor", "relay"] = "relay"
    """blink1: ThingM blink(1); luxafor: Luxafor Flag; relay: HID relay board 16c0:05df, one relay a
    colour"""
    serial: str | None = None
    """serial number when several are plugged in; null: first"""
    relay_red: Annotated[int, Meta(ge=0, le=8)] = 1
    """relay of red; 0: not wired"""
    relay_orange: Annotated[int, Meta(ge=0, le=8)] = 2
    """relay of orange; 0: not wired"""
    relay_green: Annotated[int, Meta(ge=0, le=8)] = 3
    """relay of green; 0: not wired"""
    relay_blue: Annotated[int, Meta(ge=0, le=8)] = 4
    """relay of blue; 0: not wired"""


class SoundConfig(Section, frozen=True):
    """The speaker."""

    enabled: bool = False
    """play chime and bell"""
    device: Annotated[str, Meta(min_length=1)] = "default"
    """ALSA device, as aplay -D takes it"""
    volume: Ratio = 0.8
    """0 is silent, 1 is full scale"""
    chime: str | None = None
    """WAV file of the chime; null: bikeped's own"""
    bell: str | None = None
    """WAV file of the bell; null: bikeped's own"""
    chime_cooldown_s: Annotated[float, Meta(ge=0, le=3600)] = 5.0
    """shortest time between two chimes, seconds"""
    bell_cooldown_s: Annotated[float, Meta(ge=0, le=3600)] = 1.5
    """shortest time between two bells; while ALERT lasts the bell repeats, s"""


class FeedbackConfig(Section, frozen=True):
    """The light and the speaker."""

    light: Literal["simulated", "gpio", "usb", "lamp"] = "simulated"
    """simulated writes to the log; lamp: a process of its own drives it, see the section lamp;
    `bikeped run` wants this key in the file"""
    blink_hz: Annotated[float, Meta(ge=0.5, le=5)] = 2.0
    """blinking of ALERT's red, flashes per second"""
    fault_blink_hz: Annotated[float, Meta(ge=0.25, le=5)] = 0.5
    """blinking of FAULT's orange, flashes per second"""
    recover_frames: Annotated[int, Meta(ge=1, le=150)] = 5
    """good frames in a row before the light leaves FAULT"""
    gpio: GpioConfig = msgspec.field(default_factory=GpioConfig)
    usb: UsbConfig = msgspec.field(default_factory=UsbConfig)
    sound: SoundConfig = msgspec.field(default_factory=SoundConfig)


class LampConfig(Section, frozen=True):
    """The lamp's own process, where feedback.light is lamp."""

    driver: Literal["gpio", "usb", "file"] | None = None
    """what it drives, by feedback.gpio or feedback.usb; file: for tests; must be set"""
    socket: Annotated[str, Meta(min_length=1, max_length=100)] = "/run/bikeped/lamp.socket"
    """Unix socket on which it hears the service"""
    file: str | None = None
    """file that shows the colour in place of a lamp, for driver file"""


class MqttConfig(Section, frozen=True):
    """Telemetry by MQTT."""

    enabled: bool = False
    """publish to the broker"""
    host: Annotated[str, Meta(min_length=1)] = "localhost"
    """broker's name or address, without http:// and without the port"""
    port: Annotated[int, Meta(ge=1, le=65535)] = 1883
    """broker's port"""
    site: Annotated[str, Meta(pattern="^[^/+#\\x00]+$", max_length=64)] = "crossing"
    """the <site> of the topics bikeped/<site>/..."""
    qos: Annotated[int, Meta(ge=0, le=2)] = 1
    """quality of service of state and health"""
    publish_interval_s: Annotated[float, Meta(ge=0.01, le=3600)] = 0.1
    """time between two track messages, seconds"""
    health_interval_s: Annotated[float, Meta(ge=0.1, le=3600)] = 10.0
    """time between two health messages, seconds"""
    keepalive_s: Annotated[int, Meta(ge=1, le=3600)] = 15
    """MQTT keep-alive, seconds"""
    username: str | None = None
    """user name; null: none"""
    password_file: str | None = None
    """file whose first line is the password; null: none"""
    tls: bool = False
    """encrypt the connection"""
    ca_file: str | None = None
    """CA certificates; null: the system's"""
    cert_file: str | None = None
    """client certificate; null: none"""
    key_file: str | None = None
    """key of the client certificate"""
    home_assistant: bool = False
    """announce the entities for Home Assistant's discovery"""
    discovery_prefix: Annotated[str, Meta(min_length=1)] = "homeassistant"
    """Home Assistant's discovery prefix"""


class WebConfig(Section, frozen=True):
    """The HTTP server: the pages, `/metrics` and `/healthz`."""

    enabled: bool = False
    """serve the pages, /metrics and /healthz"""
    host: Annotated[str, Meta(min_length=1)] = "127.0.0.1"
    """address to bind; any but this machine's own (127.0.0.1, ::1, localhost) needs
    web.token_file"""
    port: Annotated[int, Meta(ge=0, le=65535)] = 8080
    """port to bind; 0: any free one"""
    token_file: str | None = None
    """file whose first line is the token or password, 12 characters or more, that everything but
    the login page asks for; null: none"""
    allowed_hosts: Annotated[tuple[str, ...], Meta(max_length=32)] = ()
    """further names under which browsers may open the pages, e.g. pole7.lan"""
    max_connections: Annotated[int, Meta(ge=4, le=1000)] = 64
    """open connections; more are turned away"""
    max_viewers: Annotated[int, Meta(ge=1, le=100)] = 8
    """live pages at a time; more are turned away"""
    stream_fps: Annotated[float, Meta(gt=0, le=30)] = 10.0
    """pictures per second of the live page, while it is open"""
    stream_width: Annotated[int, Meta(ge=160, le=3840)] = 960
    """width of the live page's picture, pixels"""


class AuditConfig(Section, frozen=True):
    """The audit log: one JSON line a frame."""

    path: str | None = None
    """file to append to; null writes no audit log"""
    max_mb: Annotated[float, Meta(ge=0.01, le=100000)] = 100.0
    """size at which the file is rotated, MB"""
    keep: Annotated[int, Meta(ge=1, le=1000)] = 10
    """rotated files that are kept"""
    min_free_mb: Annotated[float, Meta(ge=0, le=1000000)] = 500.0
    """nothing is written with less free disk than this, MB"""


def is_loopback(host: str) -> bool:
    """Whether `host`, a name or an address, is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"

"""What the road user sees and hears: states to signals, lights, the speaker.

`signal_logic` is pure and decides FAULT; `light` drives a device from its own thread, `lamp_client`
speaks to the lamp's own process; the devices are those of `bikeped.lamp`, and `SimulatedLight`;
`speaker` plays the sounds of `sounds`.
"""

from __future__ import annotations

from functools import partial

from bikeped.config.output_sections import FeedbackConfig, LampConfig
from bikeped.errors import FeedbackError
from bikeped.feedback.lamp_client import LampClient
from bikeped.feedback.light import LightDriver, LightOutput, SimulatedLight
from bikeped.lamp.colours import Light
from bikeped.lamp.gpio import GpioLight, gpio_lamps
from bikeped.lamp.usb import UsbLight, relay_lamps


def check_light(config: FeedbackConfig, lamp: LampConfig) -> None:
    """Whether the wiring in the configuration can show what it must; touches no device.

    Raises FeedbackError naming the key.
    """
    kind: str | None = config.light
    if kind == "lamp":
        kind = lamp.driver
        if kind is None or (kind == "file" and lamp.file is None):
            key = "lamp.driver" if kind is None else "lamp.file"
            raise FeedbackError(f"{key} must be set where feedback.light is lamp")
    if kind == "gpio":
        gpio_lamps(config.gpio)
    elif kind == "usb" and config.usb.device == "relay":
        relay_lamps(config.usb)


def open_light(config: FeedbackConfig) -> Light:
    """Opens the configured light; FeedbackError when it is not there or does not answer.

    Its `close` darkens it, whatever colour it had before. For the lamp's own process use
    `lamp_client.ask_lamp`.
    """
    if config.light == "gpio":
        return GpioLight(config.gpio)
    if config.light == "usb":
        return UsbLight(config.usb)
    return SimulatedLight()


def light_output(config: FeedbackConfig, lamp: LampConfig) -> LightOutput:
    """The driver of the configured light, not yet started.

    Raises FeedbackError when the wiring is wrong. A device or lamp process that is missing or fails
    is retried for ever and reported in `fault`.
    """
    check_light(config, lamp)
    if config.light == "lamp":
        return LampClient(lamp.socket)
    return LightDriver(
        partial(open_light, config), name=config.light, fault_blink_hz=config.fault_blink_hz
    )

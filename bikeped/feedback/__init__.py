"""What the road user sees and hears: states to signals, lights, the speaker.

`signal_logic` is pure and decides FAULT; `light` drives a device from its own thread; `gpio`, `usb`
and `SimulatedLight` are devices; `speaker` plays the sounds of `sounds`.
"""

from __future__ import annotations

from functools import partial

from bikeped.config.output_sections import FeedbackConfig
from bikeped.feedback.gpio import GpioLight, gpio_lamps
from bikeped.feedback.light import Light, LightDriver, SimulatedLight
from bikeped.feedback.usb import UsbLight, relay_lamps


def check_light(config: FeedbackConfig) -> None:
    """Whether the wiring in the configuration can show what it must; touches no device.

    Raises FeedbackError naming the key.
    """
    if config.light == "gpio":
        gpio_lamps(config.gpio)
    elif config.light == "usb" and config.usb.device == "relay":
        relay_lamps(config.usb)


def open_light(config: FeedbackConfig) -> Light:
    """Opens the configured light; FeedbackError when it is not there or does not answer.

    Its `close` darkens it, whatever colour it had before.
    """
    if config.light == "gpio":
        return GpioLight(config.gpio)
    if config.light == "usb":
        return UsbLight(config.usb)
    return SimulatedLight()


def light_driver(config: FeedbackConfig) -> LightDriver:
    """The driver of the configured light, not yet started.

    Raises FeedbackError when the wiring is wrong. A device that is missing or fails is retried for
    ever and reported in `LightDriver.fault`.
    """
    check_light(config)
    return LightDriver(
        partial(open_light, config), name=config.light, fault_blink_hz=config.fault_blink_hz
    )

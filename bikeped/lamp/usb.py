"""USB lights and relay boards, by pyusb: no kernel driver, no vendor's library.

Protocols, each from its public description:

* ThingM blink(1), 27b8:01ed: feature report 1 of 8 bytes, `{1, 'n', r, g, b, 0, 0, 0}` sets the
  colour at once. Source: ThingM's docs/blink1-hid-commands.md in github.com/todbot/blink1.
* Luxafor Flag, 04d8:f372: 8 bytes written to the interrupt endpoint, `{0x01, led, r, g, b, 0, 0,
  0}` with led 0xFF for all. Source: docs.rs/luxafor, module `usb_hid` (MIT).
* HID relay board, 16c0:05df, product `USBRelay<n>`: feature report of 8 bytes, `{0xFF, n}` closes
  relay n and `{0xFD, n}` opens it; read back, bytes 0..4 are the board's serial number and bit n-1
  of byte 7 is relay n. Source: github.com/JPEWdev/pyhid-usb-relay (MIT). The USB ID is shared by
  all V-USB HID devices, so the product's name is checked as well.

Feature reports travel as HID class requests SET_REPORT and GET_REPORT to the interface (USB HID
1.11, section 7.2). Every transfer ends after `TIMEOUT_MS`. Every error makes the light unusable:
`LightDriver` closes it and opens a new one, which is also how a re-plugged device is found again.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol

from bikeped.errors import FeedbackError
from bikeped.lamp.colours import LAMP_COLOURS, Colour, Lamp, assign_lamps

SECTION = "feedback.usb"
TIMEOUT_MS = 300


class UsbWiring(Protocol):
    """What `feedback.usb` says, without the configuration's classes; also `relay_<colour>`."""

    @property
    def device(self) -> str: ...
    @property
    def serial(self) -> str | None: ...


_INTERFACE = 0
_SET_REPORT, _GET_REPORT = 0x09, 0x01
_CLASS_INTERFACE_OUT, _CLASS_INTERFACE_IN = 0x21, 0xA1
_FEATURE = 3

#: Red, green and blue of each colour; orange is redder than on a screen, where LEDs look yellow.
_RGB: dict[Colour, tuple[int, int, int]] = {
    Colour.OFF: (0, 0, 0),
    Colour.BLUE: (0, 0, 255),
    Colour.GREEN: (0, 255, 0),
    Colour.ORANGE: (255, 80, 0),
    Colour.RED: (255, 0, 0),
}

#: Name, vendor and product of each kind of device.
_DEVICES = {
    "blink1": ("blink(1)", 0x27B8, 0x01ED),
    "luxafor": ("Luxafor Flag", 0x04D8, 0xF372),
    "relay": ("HID relay board", 0x16C0, 0x05DF),
}


def relay_lamps(config: UsbWiring) -> dict[Colour, Lamp]:
    """The relay of each colour, 1 to 8, None for dark; FeedbackError when red is not wired."""
    wired = {c: getattr(config, f"relay_{c.value}") or None for c in LAMP_COLOURS}
    return assign_lamps(wired, SECTION)


class UsbLight:
    """A USB light or relay board, opened and claimed; raises FeedbackError when it is not there.

    `backend` takes a pyusb backend in place of libusb (tests).
    """

    def __init__(self, config: UsbWiring, *, backend: Any = None) -> None:
        name, vendor, product = _DEVICES[config.device]
        self._name = f"{name} {vendor:04x}:{product:04x}"
        self._core, self._util = _load_pyusb()
        lamps = relay_lamps(config) if config.device == "relay" else {}
        self._relays = {colour: lamp for colour, lamp in lamps.items() if isinstance(lamp, int)}
        with self._errors("cannot be opened"):
            self._device = self._find(config, backend)
            try:
                _detach(self._device)
                self._util.claim_interface(self._device, _INTERFACE)
                self._show = self._protocol(config)
            except BaseException:
                self._util.dispose_resources(self._device)
                raise

    def set(self, colour: Colour) -> None:
        """Shows `colour`; at most a few transfers of 0.3 s each."""
        with self._errors(f"{colour.value} cannot be set"):
            self._show(colour)

    def mismatch(self, colour: Colour) -> str | None:
        """Which relays are on instead of `colour`'s; None where they agree or cannot be read."""
        if not self._relays:
            return None
        with self._errors("cannot be read back"):
            on = _closed_relays(self._device) & set(self._relays.values())
        wanted = {self._relays[colour]} if colour in self._relays else set()
        return None if on == wanted else f"the relays {sorted(on)} are on"

    def close(self) -> None:
        """Switches off and releases the device."""
        try:
            self.set(Colour.OFF)
        finally:
            self._util.dispose_resources(self._device)

    def _find(self, config: UsbWiring, backend: Any) -> Any:
        """The one device that fits kind and serial number."""
        _, vendor, product = _DEVICES[config.device]
        other_devices: list[str] = []
        devices = self._core.find(
            find_all=True, idVendor=vendor, idProduct=product, backend=backend
        )
        for device in devices:
            # pyusb's default of 1 s also covers the string descriptors read here.
            device.default_timeout = TIMEOUT_MS
            if config.device == "relay" and not str(device.product or "").startswith("USBRelay"):
                other_devices.append(f"a {device.product}")
            elif config.serial is None:
                return device
            else:
                serial = self._serial(config, device)
                if serial == config.serial:
                    return device
                other_devices.append(f"serial {serial}")
            self._util.dispose_resources(device)
        wanted = self._name if config.serial is None else f"{self._name}, serial {config.serial},"
        others = f" (found {', '.join(other_devices)})" if other_devices else ""
        raise FeedbackError(f"{SECTION}.device: no {wanted} is plugged in{others}")

    def _serial(self, config: UsbWiring, device: Any) -> str:
        if config.device != "relay":
            return str(device.serial_number)
        # The board's USB serial number is the same on all of them; its own is in the report.
        _detach(device)
        return _relay_report(device)[:5].rstrip(b"\0").decode("ascii", "replace")

    def _protocol(self, config: UsbWiring) -> Callable[[Colour], object]:
        """What shows a colour on this kind of device."""
        device = self._device
        if config.device == "blink1":
            return lambda colour: _set_feature(
                device, 1, bytes([1, ord("n"), *_RGB[colour], 0, 0, 0])
            )
        if config.device == "luxafor":
            endpoint = self._out_endpoint()
            return lambda colour: device.write(
                endpoint, bytes([0x01, 0xFF, *_RGB[colour], 0, 0, 0]), TIMEOUT_MS
            )
        return partial(_show_by_relays, device, self._relays)

    def _out_endpoint(self) -> int:
        interface = self._device.get_active_configuration()[(_INTERFACE, 0)]
        for endpoint in interface:
            address = int(endpoint.bEndpointAddress)
            if self._util.endpoint_direction(address) == self._util.ENDPOINT_OUT:
                return address
        raise FeedbackError(f"{SECTION}.device: this {self._name} has no output endpoint")

    @contextlib.contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Turns pyusb's errors into FeedbackError with the remedy."""
        what = f"{SECTION}: {self._name} {what}"
        try:
            yield
        except self._core.NoBackendError as error:
            raise FeedbackError(
                f"{what}: libusb is missing; install the system package libusb-1.0-0"
            ) from error
        except (OSError, ValueError) as error:  # ValueError: descriptors that cannot be read
            remedy = ""
            if getattr(error, "errno", None) == errno.EACCES:
                remedy = "; install deploy/99-bikeped.rules, and is this user in group plugdev?"
            raise FeedbackError(f"{what}: {error}{remedy}") from error


def _show_by_relays(device: Any, relays: dict[Colour, int], colour: Colour) -> None:
    """Closes the relay of `colour`, opens the other wired ones, and reads the board back.

    Only relays that must change are switched, for mechanical ones wear.
    """
    wanted = {relays[colour]} if colour in relays else set()
    wired = set(relays.values())
    # The dark ones first, so two lamps never show at once.
    to_switch = (_closed_relays(device) & wired) ^ wanted
    for relay in sorted(to_switch, key=lambda relay: (relay in wanted, relay)):
        command = 0xFF if relay in wanted else 0xFD
        _set_feature(device, 0, bytes([command, relay, 0, 0, 0, 0, 0, 0]))
    got = _closed_relays(device) & wired
    if got != wanted:
        raise FeedbackError(
            f"{SECTION}: the relay board does not obey: relays {sorted(wanted)} were asked for, "
            f"{sorted(got)} are on; does the board have as many relays as relay_* names?"
        )


def _closed_relays(device: Any) -> set[int]:
    bits = _relay_report(device)[7]
    return {relay for relay in range(1, 9) if bits >> (relay - 1) & 1}


def _set_feature(device: Any, report_id: int, data: bytes) -> None:
    value = (_FEATURE << 8) | report_id
    sent = device.ctrl_transfer(
        _CLASS_INTERFACE_OUT, _SET_REPORT, value, _INTERFACE, data, TIMEOUT_MS
    )
    if sent != len(data):
        raise FeedbackError(f"{SECTION}: only {sent} of {len(data)} bytes were taken")


def _relay_report(device: Any) -> bytes:
    report = device.ctrl_transfer(
        _CLASS_INTERFACE_IN, _GET_REPORT, _FEATURE << 8, _INTERFACE, 8, TIMEOUT_MS
    )
    if len(report) != 8:
        raise FeedbackError(f"{SECTION}: a report of 8 bytes came with {len(report)}")
    return bytes(report)


def _detach(device: Any) -> None:
    """Takes the interface from the kernel's usbhid, which claims every HID device."""
    # NotImplementedError: a backend without kernel drivers to detach.
    with contextlib.suppress(NotImplementedError):
        if device.is_kernel_driver_active(_INTERFACE):
            device.detach_kernel_driver(_INTERFACE)


def _load_pyusb() -> tuple[Any, Any]:
    try:
        return importlib.import_module("usb.core"), importlib.import_module("usb.util")
    except ImportError as error:
        raise FeedbackError(
            "feedback.light: usb needs the Python package pyusb; install bikeped[usb]"
        ) from error

"""USB lights through the real pyusb, on a fake backend: the bytes on the wire and every error."""

from __future__ import annotations

import array
import errno
from types import SimpleNamespace
from typing import Any

import pytest
import usb.backend
import usb.core

from bikeped.config.output_sections import UsbConfig
from bikeped.errors import FeedbackError
from bikeped.lamp import usb as lights
from bikeped.lamp.usb import UsbLight
from bikeped.types import Colour

IDS = {"blink1": (0x27B8, 0x01ED), "luxafor": (0x04D8, 0xF372), "relay": (0x16C0, 0x05DF)}


class FakeDevice:
    """What a device answers, and what it was sent: (request type, request, value, index, data)."""

    def __init__(
        self, ids: tuple[int, int], *, product: str = "", serial: str = "", endpoint: int = 0x01
    ) -> None:
        self.ids, self.product, self.serial, self.endpoint = ids, product, serial, endpoint
        self.sent: list[tuple[int, int, int, int, bytes]] = []
        self.written: list[tuple[int, bytes]] = []
        self.kernel_driver = True
        self.claimed = False
        self.error: BaseException | None = None
        self.relays = 0
        self.board_serial = b"BITFT"
        self.relay_count = 8
        self.history: list[int] = []

    def get_report(self) -> bytes:
        return self.board_serial.ljust(7, b"\0") + bytes([self.relays])

    def take_report(self, data: bytes) -> None:
        command, relay = data[0], data[1]
        if command in (0xFF, 0xFD) and relay <= self.relay_count:
            bit = 1 << (relay - 1)
            self.relays = self.relays | bit if command == 0xFF else self.relays & ~bit
            self.history.append(self.relays)


class FakeBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A bus with fake devices, as pyusb's libusb backend would show it."""

    def __init__(self, *devices: FakeDevice) -> None:
        self.devices = list(devices)
        self.opened = 0
        self.timeouts: set[int] = set()

    def enumerate_devices(self) -> Any:
        return iter(self.devices)

    def get_device_descriptor(self, dev: FakeDevice) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x110, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=8, idVendor=dev.ids[0], idProduct=dev.ids[1],
            bcdDevice=0x100, iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1,
            address=1, bus=1, port_number=1, port_numbers=(1,), speed=1,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: FakeDevice, config: int) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=34, bNumInterfaces=1,
            bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=50,
            extra_descriptors=array.array("B"),
        )  # fmt: skip

    def get_interface_descriptor(
        self, dev: FakeDevice, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        if intf or alt or config:
            raise IndexError("no such interface")
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0,
            bNumEndpoints=1, bInterfaceClass=3, bInterfaceSubClass=0, bInterfaceProtocol=0,
            iInterface=0, extra_descriptors=array.array("B"),
        )  # fmt: skip

    def get_endpoint_descriptor(
        self, dev: FakeDevice, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        if ep:
            raise IndexError("no such endpoint")
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=dev.endpoint, bmAttributes=3,
            wMaxPacketSize=8, bInterval=10, bRefresh=0, bSynchAddress=0,
            extra_descriptors=array.array("B"),
        )  # fmt: skip

    def open_device(self, dev: FakeDevice) -> FakeDevice:
        if dev.error is not None:
            raise dev.error
        self.opened += 1
        return dev

    def close_device(self, handle: FakeDevice) -> None:
        self.opened -= 1

    def get_configuration(self, handle: FakeDevice) -> int:
        return 1

    def is_kernel_driver_active(self, handle: FakeDevice, intf: int) -> bool:
        return handle.kernel_driver

    def detach_kernel_driver(self, handle: FakeDevice, intf: int) -> None:
        handle.kernel_driver = False

    def claim_interface(self, handle: FakeDevice, intf: int) -> None:
        if handle.kernel_driver:
            raise usb.core.USBError("Resource busy", errno=errno.EBUSY)
        handle.claimed = True

    def release_interface(self, handle: FakeDevice, intf: int) -> None:
        handle.claimed = False

    def intr_write(
        self, handle: FakeDevice, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        if handle.error is not None:
            raise handle.error
        assert handle.claimed
        self.timeouts.add(timeout)
        handle.written.append((ep, data.tobytes()))
        return len(data)

    def ctrl_transfer(
        self,
        handle: FakeDevice,
        request_type: int,
        request: int,
        value: int,
        index: int,
        data: array.array[int],
        timeout: int,
    ) -> int:
        if handle.error is not None:
            raise handle.error
        self.timeouts.add(timeout)
        if request_type == 0x80:
            return _fill(data, self._descriptor(handle, value & 0xFF))
        assert handle.claimed
        if request_type == 0xA1:
            assert (request, value, index) == (0x01, 0x0300, 0)
            return _fill(data, handle.get_report())
        handle.sent.append((request_type, request, value, index, data.tobytes()))
        handle.take_report(data.tobytes())
        return len(data)

    @staticmethod
    def _descriptor(handle: FakeDevice, index: int) -> bytes:
        if index == 0:
            return bytes([4, 3, 0x09, 0x04])  # language: US English
        text = {1: "maker", 2: handle.product, 3: handle.serial}[index].encode("utf-16-le")
        return bytes([2 + len(text), 3]) + text


def _fill(buffer: array.array[int], data: bytes) -> int:
    taken = data[: len(buffer)]
    for index, byte in enumerate(taken):
        buffer[index] = byte
    return len(taken)


def relay_board(product: str = "USBRelay4") -> FakeDevice:
    return FakeDevice(IDS["relay"], product=product, serial="00000")


def relays(device: FakeDevice, **config: Any) -> UsbLight:
    return UsbLight(UsbConfig(device="relay", **config), backend=FakeBackend(device))


def test_blink1_gets_one_feature_report_a_colour() -> None:
    device = FakeDevice(IDS["blink1"])
    backend = FakeBackend(device)
    light = UsbLight(UsbConfig(device="blink1"), backend=backend)
    for colour in (Colour.RED, Colour.BLUE, Colour.OFF):
        light.set(colour)
    assert device.sent == [
        (0x21, 0x09, 0x0301, 0, bytes([1, 0x6E, 255, 0, 0, 0, 0, 0])),
        (0x21, 0x09, 0x0301, 0, bytes([1, 0x6E, 0, 0, 255, 0, 0, 0])),
        (0x21, 0x09, 0x0301, 0, bytes([1, 0x6E, 0, 0, 0, 0, 0, 0])),
    ]
    assert backend.timeouts == {300}


@pytest.mark.parametrize("endpoint", [0x01, 0x02])
def test_luxafor_is_written_to_its_output_endpoint(endpoint: int) -> None:
    device = FakeDevice(IDS["luxafor"], endpoint=endpoint)
    backend = FakeBackend(device)
    light = UsbLight(UsbConfig(device="luxafor"), backend=backend)
    light.set(Colour.GREEN)
    assert device.written == [(endpoint, bytes([0x01, 0xFF, 0, 255, 0, 0, 0, 0]))]
    assert backend.timeouts == {300}


def test_luxafor_without_an_output_endpoint_is_refused_and_let_go() -> None:
    backend = FakeBackend(FakeDevice(IDS["luxafor"], endpoint=0x81))
    with pytest.raises(FeedbackError, match="no output endpoint"):
        UsbLight(UsbConfig(device="luxafor"), backend=backend)
    assert backend.opened == 0


def test_orange_is_neither_red_nor_green_to_the_eye() -> None:
    device = FakeDevice(IDS["blink1"])
    UsbLight(UsbConfig(device="blink1"), backend=FakeBackend(device)).set(Colour.ORANGE)
    red, green, blue = device.sent[0][4][2:5]
    assert red == 255
    assert 40 <= green <= 140
    assert blue == 0


def test_relays_switch_off_before_on_and_only_what_must_change() -> None:
    device = relay_board()
    light = relays(device)
    for colour in (Colour.GREEN, Colour.GREEN, Colour.RED, Colour.OFF):
        light.set(colour)
    assert [(item[2], item[4][:2]) for item in device.sent] == [
        (0x0300, bytes([0xFF, 3])),
        (0x0300, bytes([0xFD, 3])),
        (0x0300, bytes([0xFF, 1])),
        (0x0300, bytes([0xFD, 1])),
    ]
    assert all(len(item[4]) == 8 for item in device.sent)
    assert device.history == [0b100, 0, 1, 0]


def test_relays_of_others_are_left_alone() -> None:
    device = relay_board("USBRelay8")
    device.relays = 0b1000_0000
    light = relays(device)
    light.set(Colour.BLUE)
    light.close()
    assert device.history == [0b1000_1000, 0b1000_0000]


def test_a_board_that_does_not_obey_is_an_error() -> None:
    device = relay_board("USBRelay2")
    device.relay_count = 2
    light = relays(device)
    light.set(Colour.RED)
    with pytest.raises(FeedbackError, match=r"does not obey.*\[3\] were asked for, \[\] are on"):
        light.set(Colour.GREEN)
    assert device.relays == 0


def test_orange_falls_back_to_the_red_relay() -> None:
    device = relay_board()
    light = relays(device, relay_orange=0, relay_green=0, relay_blue=0)
    light.set(Colour.ORANGE)
    assert device.relays == 1
    light.set(Colour.GREEN)
    assert device.relays == 0


def test_the_kernel_driver_is_detached_and_everything_let_go_at_close() -> None:
    device = relay_board()
    backend = FakeBackend(device)
    light = UsbLight(UsbConfig(device="relay"), backend=backend)
    assert not device.kernel_driver
    light.set(Colour.RED)
    light.close()
    assert device.relays == 0
    assert backend.opened == 0


def test_serial_numbers_choose_among_several() -> None:
    first, second = relay_board(), relay_board()
    second.board_serial = b"ABCDE"
    light = UsbLight(UsbConfig(device="relay", serial="ABCDE"), backend=FakeBackend(first, second))
    light.set(Colour.RED)
    assert (first.relays, second.relays) == (0, 1)
    one, two = (FakeDevice(IDS["blink1"], serial=serial) for serial in ("1234", "5678"))
    UsbLight(UsbConfig(device="blink1", serial="5678"), backend=FakeBackend(one, two)).set(
        Colour.RED
    )
    assert not one.sent
    assert two.sent


def test_strangers_with_the_shared_usb_id_are_not_taken_for_a_relay_board() -> None:
    backend = FakeBackend(relay_board("HIDKeys"))
    with pytest.raises(FeedbackError, match=r"no HID relay board.*\(found a HIDKeys\)"):
        UsbLight(UsbConfig(device="relay"), backend=backend)
    assert backend.opened == 0


def test_a_missing_device_is_named() -> None:
    with pytest.raises(FeedbackError, match=r"feedback\.usb\.device: no Luxafor Flag 04d8:f372"):
        UsbLight(UsbConfig(device="luxafor"), backend=FakeBackend())
    with pytest.raises(FeedbackError, match="serial XYZ"):
        UsbLight(UsbConfig(device="blink1", serial="XYZ"), backend=FakeBackend())


def test_no_permission_says_what_to_install() -> None:
    device = FakeDevice(IDS["blink1"])
    device.error = usb.core.USBError("Access denied", errno=errno.EACCES)
    with pytest.raises(FeedbackError, match=r"99-bikeped\.rules.*plugdev"):
        UsbLight(UsbConfig(device="blink1"), backend=FakeBackend(device))


def test_unplugging_is_an_error_and_replugging_is_found_by_a_new_light() -> None:
    device = FakeDevice(IDS["blink1"])
    backend = FakeBackend(device)
    light = UsbLight(UsbConfig(device="blink1"), backend=backend)
    device.error = usb.core.USBError("No such device", errno=errno.ENODEV)
    with pytest.raises(FeedbackError, match=r"red cannot be set.*No such device"):
        light.set(Colour.RED)
    with pytest.raises(FeedbackError, match="off cannot be set"):
        light.close()
    again = FakeDevice(IDS["blink1"])
    backend.devices = [again]
    UsbLight(UsbConfig(device="blink1"), backend=backend).set(Colour.RED)
    assert len(again.sent) == 1


def test_a_timeout_is_a_feedback_error() -> None:
    device = FakeDevice(IDS["blink1"])
    light = UsbLight(UsbConfig(device="blink1"), backend=FakeBackend(device))
    device.error = usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
    with pytest.raises(FeedbackError, match="timed out"):
        light.set(Colour.RED)


def test_missing_libusb_and_missing_pyusb_say_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_backend(**_: Any) -> Any:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", no_backend)
    with pytest.raises(FeedbackError, match=r"libusb-1.0-0"):
        UsbLight(UsbConfig(device="blink1"))

    def no_module(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(lights.importlib, "import_module", no_module)  # type: ignore[attr-defined]
    with pytest.raises(FeedbackError, match=r"bikeped\[usb\]"):
        UsbLight(UsbConfig(device="blink1"))

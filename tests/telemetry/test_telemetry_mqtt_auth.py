"""Credentials: every unusable file or contradiction is one line with file, key and remedy."""

from __future__ import annotations

import shutil
import ssl
import subprocess
from pathlib import Path

import pytest

from bikeped.config.output_sections import MqttConfig
from bikeped.errors import TelemetryError
from bikeped.telemetry.mqtt import MqttPublisher
from bikeped.telemetry.mqtt_connection import load_credentials, sends_password_in_clear


@pytest.mark.parametrize(
    ("content", "password"),
    [
        ("secret\n", "secret"),
        ("secret", "secret"),
        ("secret\r\nnote\n", "secret"),
        (" spaces stay \n", " spaces stay "),
        ("pässword\n", "pässword"),
    ],
)
def test_the_password_is_the_first_line(tmp_path: Path, content: str, password: str):
    (tmp_path / "secret").write_bytes(content.encode())
    config = MqttConfig(username="pole", password_file="secret")
    credentials = load_credentials(config, tmp_path)
    assert credentials.password == password
    assert password not in repr(credentials)


def test_nothing_asked_gives_nothing():
    credentials = load_credentials(MqttConfig())
    assert (credentials.username, credentials.password, credentials.tls) == (None, None, None)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"username": "u", "password_file": "absent"}, ["absent", "mqtt.password_file", "read"]),
        ({"username": "u", "password_file": "empty"}, ["empty", "mqtt.password_file", "write"]),
        ({"username": "u", "password_file": "binary"}, ["binary", "mqtt.password_file", "UTF-8"]),
        ({"password_file": "empty"}, ["mqtt.password_file", "set mqtt.username"]),
        ({"ca_file": "empty"}, ["mqtt.ca_file", "set mqtt.tls: true"]),
        ({"cert_file": "empty"}, ["mqtt.cert_file", "set mqtt.tls: true"]),
        ({"tls": True, "key_file": "empty"}, ["mqtt.key_file", "mqtt.cert_file"]),
        ({"tls": True, "ca_file": "absent"}, ["absent", "mqtt.ca_file", "give"]),
        ({"tls": True, "ca_file": "text"}, ["text", "mqtt.ca_file", "give"]),
        ({"tls": True, "cert_file": "text"}, ["text", "mqtt.cert_file", "give"]),
        (
            {"tls": True, "cert_file": "text", "key_file": "absent"},
            ["absent", "mqtt.key_file", "give"],
        ),
    ],
)
def test_what_cannot_be_used_is_said_when_the_publisher_is_made(tmp_path: Path, keys, words):
    (tmp_path / "empty").write_text("")
    (tmp_path / "text").write_text("no certificate\n")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    with pytest.raises(TelemetryError) as caught:
        MqttPublisher(MqttConfig(**keys), base_dir=tmp_path)
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_an_encrypted_key_is_refused_instead_of_asked_about_on_a_terminal(tmp_path: Path):
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("openssl is not installed")
    key, cert = tmp_path / "k.pem", tmp_path / "c.pem"
    subprocess.run(
        [
            *(program, "req", "-x509", "-newkey", "rsa:2048", "-passout", "pass:secret"),
            *("-keyout", key, "-out", cert, "-days", "2", "-subj", "/CN=pole"),
        ],
        check=True,
        capture_output=True,
    )
    config = MqttConfig(tls=True, cert_file="c.pem", key_file="k.pem")
    with pytest.raises(TelemetryError, match="unencrypted"):
        load_credentials(config, tmp_path)


def test_tls_verifies_the_broker():
    context = load_credentials(MqttConfig(tls=True)).tls
    assert context is not None
    assert context.verify_mode is ssl.CERT_REQUIRED
    assert context.check_hostname


@pytest.mark.parametrize(
    ("keys", "clear"),
    [
        ({"host": "broker.example"}, True),
        ({"host": "broker.example", "tls": True}, False),
        ({"host": "127.0.0.1"}, False),
        ({"host": "broker.example", "username": None, "password_file": None}, False),
    ],
)
def test_a_password_in_the_clear_is_noticed(tmp_path, caplog, keys, clear):
    (tmp_path / "secret").write_text("s\n")
    config = MqttConfig(**{"username": "u", "password_file": "secret", **keys})
    assert sends_password_in_clear(config) is clear
    MqttPublisher(config, base_dir=tmp_path)
    assert ("unencrypted" in caplog.text) is clear

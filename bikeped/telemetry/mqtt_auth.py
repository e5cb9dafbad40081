"""Credentials and TLS of the connection to the broker."""

from __future__ import annotations

import ssl
from dataclasses import dataclass, field
from pathlib import Path

from bikeped.config.schema import MqttConfig
from bikeped.errors import TelemetryError

_LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class Credentials:
    """User name, password and TLS context; None: without."""

    username: str | None
    password: str | None = field(repr=False)
    tls: ssl.SSLContext | None = None


def load_credentials(config: MqttConfig, base_dir: Path = Path()) -> Credentials:
    """Reads the files that `config` names; relative ones are relative to `base_dir`.

    Raises TelemetryError, naming file, key and remedy, when a file cannot be used or keys
    contradict one another: a certificate without `tls` would mean an unencrypted connection that
    its owner believes encrypted.
    """
    _check_keys(config)
    password = None
    if config.password_file is not None:
        password = _first_line(base_dir / config.password_file)
    return Credentials(config.username, password, _tls(config, base_dir) if config.tls else None)


def sends_password_in_clear(config: MqttConfig) -> bool:
    """Whether the password leaves this machine unencrypted."""
    return config.password_file is not None and not config.tls and config.host not in _LOOPBACK


def _check_keys(config: MqttConfig) -> None:
    if config.password_file is not None and config.username is None:
        raise TelemetryError(
            "mqtt.password_file is set without mqtt.username: set mqtt.username, or remove it"
        )
    for key in ("ca_file", "cert_file", "key_file"):
        if getattr(config, key) is not None and not config.tls:
            raise TelemetryError(
                f"mqtt.{key} is set but mqtt.tls is false, so nothing would be encrypted: "
                f"set mqtt.tls: true, or remove mqtt.{key}"
            )
    if config.key_file is not None and config.cert_file is None:
        raise TelemetryError(
            "mqtt.key_file is set without mqtt.cert_file: set both, or remove mqtt.key_file"
        )


def _first_line(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as exc:
        raise TelemetryError(
            f"{path}: mqtt.password_file cannot be read ({exc.strerror}): "
            "give a file that the service may read"
        ) from exc
    except UnicodeDecodeError as exc:
        raise TelemetryError(
            f"{path}: mqtt.password_file is not UTF-8 text: write the password as its first line"
        ) from exc
    password = text.partition("\n")[0].rstrip("\r")
    if not password:
        raise TelemetryError(
            f"{path}: mqtt.password_file has an empty first line: write the password there"
        )
    return password


def _tls(config: MqttConfig, base_dir: Path) -> ssl.SSLContext:
    ca_file = None if config.ca_file is None else base_dir / config.ca_file
    try:
        context = ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as exc:
        raise TelemetryError(
            f"{ca_file}: mqtt.ca_file cannot be used ({_reason(exc)}): "
            "give the PEM file of the authority that signed the broker's certificate"
        ) from exc
    if config.cert_file is not None:
        cert_file = base_dir / config.cert_file
        key_file = None if config.key_file is None else base_dir / config.key_file
        try:
            # An encrypted key would otherwise make OpenSSL prompt on the terminal.
            context.load_cert_chain(cert_file, key_file, password=_no_password)
        except (OSError, ssl.SSLError) as exc:
            files = f"{cert_file}" if key_file is None else f"{cert_file}, {key_file}"
            raise TelemetryError(
                f"{files}: mqtt.cert_file and mqtt.key_file cannot be used ({_reason(exc)}): "
                "give PEM files of a client certificate and its unencrypted key"
            ) from exc
    return context


def _no_password() -> str:
    return ""


def _reason(exc: OSError) -> str:
    # An SSLError's strerror may be missing; some texts span lines.
    return " ".join((exc.strerror or str(exc) or type(exc).__name__).split())

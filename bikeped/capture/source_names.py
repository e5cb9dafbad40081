"""What a camera is called: addresses without passwords, devices by names that last.

`shown_source` is the one place that makes a camera's source fit to be read by people: every log
line, fault, page and message names the source through it.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from urllib.parse import quote

from bikeped.config.schema import CameraConfig
from bikeped.errors import CaptureError

_log = logging.getLogger(__name__)

_ADDRESS = re.compile(r"\s*([A-Za-z][A-Za-z0-9+.-]*):/")
_HOST = re.compile(r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.%]+\])(?::[0-9]{1,5})?")
#: Where udev links to a camera by its serial number, and by the port that it is plugged into.
_LINK_FOLDERS = ("v4l/by-id", "v4l/by-path")


def shown_source(source: str) -> str:
    """`source` for people: of an address only scheme, host and port, as `rtsp://cam:554/...`.

    A password may stand in front of the host, in the path or in the query, and may hold `/`, `?`,
    `#` and `@`. Where these leave open which part is the host, not even that is shown. A device
    or file stays as it is.
    """
    scheme = _ADDRESS.match(source)
    if scheme is None:
        return source
    rest = source[scheme.end() :].lstrip("/")
    authority = re.split(r"[/?#\\]", rest, maxsplit=1)[0]
    host = authority.rpartition("@")[2]
    if "@" in rest[len(authority) :] or not _HOST.fullmatch(host):
        return f"{scheme[1]}://..."
    return f"{scheme[1]}://{host}" + ("" if rest == authority else "/...")


def address_with_login(camera: CameraConfig, source: str, base_dir: Path) -> str:
    """The address with `camera.username` and the password of `camera.password_file`, if set.

    They replace a login that the address holds. Raises CaptureError, naming file and key.
    """
    if camera.username is None:
        return source
    login = quote(camera.username, safe="")
    if camera.password_file is not None:
        path = base_dir / Path(camera.password_file).expanduser()
        try:
            password = path.read_text(encoding="utf-8").partition("\n")[0].strip("\r")
        except (OSError, UnicodeDecodeError) as error:
            why = getattr(error, "strerror", None) or "it is not UTF-8 text"
            raise CaptureError(
                f"{path}: camera.password_file cannot be read ({why}); write the password as its "
                "first line, readable by the service"
            ) from error
        if not password:
            raise CaptureError(f"{path}: camera.password_file has an empty first line; write it")
        login += f":{quote(password, safe='')}"
    scheme, _, rest = source.partition("://")
    authority, slash, path_part = rest.partition("/")
    return f"{scheme}://{login}@{authority.rpartition('@')[2]}{slash}{path_part}"


class DeviceNames:
    """Finds a camera again that comes back under another /dev/videoN.

    The kernel numbers cameras in the order in which they appear; udev's links below `root`/v4l
    name them by serial number and by port. The links of a camera that was opened are remembered
    for as long as the process lives: a source of /dev/v4l/by-id/... lasts longer.
    """

    def __init__(self, root: Path = Path("/dev")) -> None:
        self._root = root
        self._links: dict[str, list[Path]] = {}  # by configured device, the surest first

    def remember(self, device: str, path: str) -> None:
        """The camera configured as `device` was opened at `path`."""
        node = Path(path).resolve()
        found = [
            link
            for folder in _LINK_FOLDERS
            for link in sorted((self._root / folder).glob("*"))
            if link.resolve() == node
        ]
        if found:
            self._links[device] = found

    def find(self, device: str) -> str:
        """Where the camera configured as `device` is now.

        `device` where no link of it is known; its surest link, which is missing then, where all are
        gone: never another camera that has taken its number.
        """
        links = self._links.get(device)
        if links is None:
            return device
        link = next((link for link in links if link.exists()), links[0])
        now_at = str(link.resolve())
        if now_at != str(Path(device).resolve()) and link.exists():
            _log.warning("%s is %s now, found as %s", device, now_at, link)
        return now_at if link.exists() else str(link)

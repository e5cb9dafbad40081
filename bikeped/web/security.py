"""Access control of the pages: host names, origins, the token, body sizes, headers.

One middleware checks, in this order: the Host is one of this machine's names (DNS rebinding);
another site's page may link here, but neither embed nor fetch nor post (Origin and Fetch Metadata);
the body is not too large; and where a token is configured, the request has it. A browser gives the
token once, on the login page or in a link `/?token=...`, and keeps a cookie; programs send
`Authorization: Bearer TOKEN`.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import ipaddress
import socket
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import hdrs, web

from bikeped.config.output_sections import WebConfig, is_loopback
from bikeped.errors import ConfigError
from bikeped.telemetry.http_server import host_name

COOKIE = "bikeped_session"
SESSION_S = 7 * 24 * 3600
SHORTEST_TOKEN = 12
#: Bytes of a request's body: settings and scenarios, as text.
MAX_BODY = 1024 * 1024
BODY_S = 20.0  #: how long a body may take to arrive
#: Paths that need no session: what the login page is made of.
_OPEN = ("/login", "/session", "/static/")
_SAFE_METHODS = frozenset({hdrs.METH_GET, hdrs.METH_HEAD, hdrs.METH_OPTIONS})

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        "connect-src 'self'; font-src 'self'; form-action 'self'; base-uri 'none'; "
        "frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    # Not no-referrer: forms would then be posted with "Origin: null".
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=()",
}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(frozen=True)
class AccessPolicy:
    """Which host names are served, and which token opens a session.

    `names`: host names of this machine; `any_address`: plain IP addresses are served too (DNS
    rebinding needs a name). `token` None: no login, every client of the port has access.
    """

    names: frozenset[str]
    any_address: bool = False
    token: str | None = field(default=None, repr=False)

    def knows_host(self, header: str) -> bool:
        """Whether a Host header names this machine."""
        name = host_name(header)
        return name in self.names or (self.any_address and _is_address(name))

    def is_token(self, given: str) -> bool:
        """Whether `given` is the token; takes the same time for every wrong one."""
        if self.token is None:
            return False
        return hmac.compare_digest(_digest(given), _digest(self.token))

    def new_cookie(self, now_s: float) -> str:
        """A session's cookie; valid across restarts, until the token is changed."""
        expires = f"{now_s + SESSION_S:.0f}"
        return f"{expires}.{self._sign(expires)}"

    def is_cookie(self, cookie: str, now_s: float) -> bool:
        """Whether a cookie was signed with this token and has not expired."""
        expires, _, signature = cookie.partition(".")
        if self.token is None or not (expires.isascii() and expires.isdigit()):
            return False
        right = hmac.compare_digest(_digest(signature), _digest(self._sign(expires)))
        return right and len(expires) < 16 and now_s < float(expires)

    def has_session(self, request: web.Request) -> bool:
        """Whether a request needs no token: none is configured, or its cookie is valid."""
        return self.token is None or self.is_cookie(request.cookies.get(COOKIE, ""), time.time())

    def _sign(self, text: str) -> str:
        key = (self.token or "").encode()
        return hmac.new(key, f"bikeped session {text}".encode(), hashlib.sha256).hexdigest()


def load_access_policy(
    config: WebConfig, base_dir: Path = Path(), source: str = "web"
) -> AccessPolicy:
    """The access policy of this configuration; `source` names it in errors.

    Raises ConfigError when others could reach the pages without a token, or when the token's file
    cannot be used.
    """
    local = is_loopback(config.host)
    token = None
    if config.token_file is not None:
        token = _read_token(base_dir / Path(config.token_file).expanduser())
    elif not local:
        raise ConfigError(
            f"{source}: web.host: {config.host} can be reached by others, who would see the "
            "camera's picture; set web.token_file too, or web.host: 127.0.0.1"
        )
    names = {"localhost", "127.0.0.1", "::1", *config.allowed_hosts}
    if not _is_address(config.host) or local:
        names.add(config.host)
    if not local:
        own = socket.gethostname()
        names |= {own, f"{own.partition('.')[0]}.local"}
    return AccessPolicy(frozenset(map(str.lower, names)), any_address=not local, token=token)


def _read_token(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"{path}: web.token_file cannot be read ({error.strerror}); give a file that the "
            "service may read"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: web.token_file is not UTF-8 text; write the token as its first line"
        ) from error
    token = text.partition("\n")[0].strip()
    if len(token) < SHORTEST_TOKEN:
        raise ConfigError(
            f"{path}: web.token_file: its first line has {len(token)} characters and could be "
            f"guessed; write {SHORTEST_TOKEN} or more, e.g. from: openssl rand -hex 16"
        )
    return token


@dataclass
class FailedLogins:
    """Wrong tokens of the last `window_s` seconds, by client address and in all; bounded."""

    per_address: int = 6
    overall: int = 100
    window_s: float = 60.0
    clock: Callable[[], float] = time.monotonic
    _by_address: OrderedDict[str, list[float]] = field(default_factory=OrderedDict)

    def count(self, address: str) -> None:
        """One more wrong token from `address`."""
        times = self._recent(self._by_address.pop(address, []))
        self._by_address[address] = [*times, self.clock()][-self.per_address :]
        while len(self._by_address) > self.overall:
            self._by_address.popitem(last=False)

    def wait_s(self, address: str) -> float:
        """Seconds until a token from `address` is checked again; 0: now."""
        mine = self._recent(self._by_address.get(address, []))
        if len(mine) >= self.per_address:
            return mine[0] + self.window_s - self.clock()
        everyone = sorted(t for times in self._by_address.values() for t in self._recent(times))
        if len(everyone) >= self.overall:
            return everyone[-self.overall] + self.window_s - self.clock()
        return 0.0

    def _recent(self, times: list[float]) -> list[float]:
        since_s = self.clock() - self.window_s
        return [t for t in times if t > since_s]


def guard(
    policy: AccessPolicy, login: Callable[[web.Request], web.Response], failures: FailedLogins
) -> Any:
    """The middleware. `login` answers requests without a session or Bearer token."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        if not policy.knows_host(request.headers.get(hdrs.HOST, "")):
            raise web.HTTPForbidden(
                text="This Host is not allowed: open the pages by this machine's address or as "
                "http://localhost, or name the host in web.allowed_hosts."
            )
        if not _is_same_origin(request):
            raise web.HTTPForbidden(text="Another site may not do this: open the page itself.")
        await _read_body(request)
        if request.path.startswith(_OPEN) or policy.has_session(request):
            return await handler(request)
        scheme, _, given = request.headers.get(hdrs.AUTHORIZATION, "").partition(" ")
        if scheme.lower() == "bearer":
            check_token(policy, failures, request, given.strip())
            return await handler(request)
        return login(request)

    return check


async def _read_body(request: web.Request) -> None:
    """Reads the body, which the request keeps; HTTPRequestEntityTooLarge from MAX_BODY on.

    On every path, also where nothing wants it: what is not read here would arrive all the same.
    """
    try:
        if (request.content_length or 0) <= MAX_BODY:
            await asyncio.wait_for(request.read(), BODY_S)
            return
    except asyncio.TimeoutError as error:
        raise web.HTTPRequestTimeout(text="The request's body did not arrive.") from error
    except web.HTTPRequestEntityTooLarge:  # of unknown length
        pass
    raise web.HTTPRequestEntityTooLarge(
        max_size=MAX_BODY,
        actual_size=request.content_length or MAX_BODY + 1,
        headers={hdrs.CONNECTION: "close"},
    )


def check_token(
    policy: AccessPolicy, failures: FailedLogins, request: web.Request, given: str
) -> None:
    """Raises HTTPTooManyRequests or HTTPUnauthorized unless `given` is the token."""
    address = _rate_limit_key(request.remote or "")
    wait_s = failures.wait_s(address)
    if wait_s > 0:
        raise web.HTTPTooManyRequests(
            text=f"Too many wrong tokens: try again in {wait_s:.0f} s.",
            headers={hdrs.RETRY_AFTER: f"{wait_s:.0f}"},
        )
    if not policy.is_token(given):
        failures.count(address)
        raise web.HTTPUnauthorized(
            text="This token is not the one in web.token_file.",
            headers={hdrs.WWW_AUTHENTICATE: "Bearer"},
        )


def _is_same_origin(request: web.Request) -> bool:
    """Whether the request comes from one of these pages, the address bar or a program.

    Another site's page may link here (a navigation), not embed, fetch or post.
    """
    headers = request.headers
    changes = request.method not in _SAFE_METHODS or hdrs.UPGRADE in headers
    if hdrs.ORIGIN in headers and not _origin_matches_host(headers):
        return False
    site = headers.get("Sec-Fetch-Site")
    if site is None or site == "same-origin":
        return True
    if changes:
        return False
    opened = headers.get("Sec-Fetch-Mode") == "navigate"
    return site == "none" or (opened and headers.get("Sec-Fetch-Dest") == "document")


def _origin_matches_host(headers: Mapping[str, str]) -> bool:
    with contextlib.suppress(ValueError):
        origin, host = urlsplit(headers[hdrs.ORIGIN]), headers.get(hdrs.HOST, "")
        return origin.scheme in ("http", "https") and origin.netloc.lower() == host.strip().lower()
    return False


def _is_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


def _rate_limit_key(address: str) -> str:
    """An IPv4 address, or the /64 of an IPv6 address, which one client may have as a whole."""
    with contextlib.suppress(ValueError):
        return str(ipaddress.IPv6Network((address.partition("%")[0], 64), strict=False))
    return address


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()

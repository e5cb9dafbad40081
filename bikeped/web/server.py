"""The web application around the pages: common frame, static files, login, errors."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import re
import signal as signals
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from aiohttp import hdrs, web

from bikeped import __version__
from bikeped.config.output_sections import WebConfig
from bikeped.errors import BikepedError
from bikeped.telemetry.http_server import HttpServer
from bikeped.templates import render
from bikeped.web.security import (
    COOKIE,
    HEADERS,
    MAX_BODY,
    SESSION_S,
    AccessPolicy,
    FailedLogins,
    Handler,
    check_token,
    guard,
    load_access_policy,
)

log = logging.getLogger(__name__)

T = TypeVar("T")

#: `static/` and `templates/` that all pages share, with those of the live and align pages.
WEB_FOLDER = Path(__file__).parent
_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
#: The order of the navigation.
_ORDER = ("/", "/align", "/testbench")


@dataclass(frozen=True)
class Page:
    """A page: `path`, its `label` in the navigation, the `title` of its window.

    `template` is a file of `templates/`, the inside of <main>; `scripts` (modules) and `styles` are
    files of `static/`, loaded after the common ones. `folder` holds `templates/` and `static/` of
    the page's own, beside the common ones.
    """

    path: str
    label: str
    title: str
    template: str
    scripts: Sequence[str] = ()
    styles: Sequence[str] = ()
    folder: Path = WEB_FOLDER


_PAGES: web.AppKey[list[Page]] = web.AppKey("pages", list)
_POLICY: web.AppKey[AccessPolicy] = web.AppKey("policy", AccessPolicy)
_FAILED_LOGINS: web.AppKey[FailedLogins] = web.AppKey("failed_logins", FailedLogins)
_FILES: web.AppKey[dict[str, _File]] = web.AppKey("files", dict)


@dataclass(frozen=True)
class _File:
    data: bytes
    content_type: str
    etag: str


def make_application(
    policy: AccessPolicy, *page_adders: Callable[[web.Application], None]
) -> web.Application:
    """The application: each of `page_adders` adds its page and routes to it."""
    failures = FailedLogins()
    app = web.Application(
        middlewares=[guard(policy, _answer_without_session, failures), _errors],
        client_max_size=MAX_BODY,
    )
    app[_PAGES], app[_FILES] = [], _load_static(WEB_FOLDER)
    app[_POLICY], app[_FAILED_LOGINS] = policy, failures
    app.on_response_prepare.append(_set_security_headers)
    app.router.add_get("/static/{name:.+}", _static)
    app.router.add_get("/{name:favicon.ico}", _static)
    app.router.add_get("/session", _session)
    app.router.add_get("/login", _login_form)
    app.router.add_post("/login", _log_in)
    app.router.add_post("/logout", _log_out)
    for add in page_adders:
        add(app)
    paths = [page.path for page in app[_PAGES]]
    if paths and "/" not in paths:
        app.router.add_get("/", partial(_redirect, paths[0]))
    return app


def add_page(app: web.Application, page: Page) -> None:
    """Adds a page and its entry in the navigation; serves its static files below /static/."""
    if page.folder != WEB_FOLDER:
        app[_FILES].update(_load_static(page.folder))
    app[_PAGES].append(page)
    app[_PAGES].sort(key=lambda p: _ORDER.index(p.path) if p.path in _ORDER else len(_ORDER))

    async def show(request: web.Request) -> web.Response:
        if "token" in request.query:  # used already; it must not stay in the address bar
            raise web.HTTPFound(page.path)
        return _page(request, page)

    app.router.add_get(page.path, show)


def serve_pages(
    config: WebConfig,
    *page_adders: Callable[[web.Application], None],
    announce: Callable[[str], None],
    base_dir: Path = Path(),
    source: str = "web",
) -> None:
    """Serves the pages that `page_adders` add until SIGINT or SIGTERM; `announce` gets the address.

    Raises ConfigError when others could reach them without a token, BikepedError when the port
    cannot be bound.
    """
    app = make_application(load_access_policy(config, base_dir, source), *page_adders)
    asyncio.run(_serve(config, app, announce))


async def _serve(config: WebConfig, app: web.Application, announce: Callable[[str], None]) -> None:
    stop = asyncio.Event()
    for number in (signals.SIGTERM, signals.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    server = HttpServer(app, config)
    if not await server.start():
        raise BikepedError(str(server.error))
    try:
        announce(str(server.address))
        await stop.wait()
    finally:
        await server.stop()


async def json_body(request: web.Request, kind: type[T]) -> T:
    """The request's JSON as `kind` (a msgspec type); BikepedError when it is not one."""
    if request.content_type != "application/json":
        raise web.HTTPUnsupportedMediaType(text="Send JSON: Content-Type: application/json.")
    try:
        return msgspec.json.decode(await request.read(), type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BikepedError(f"request: {error}") from error


def json_answer(data: Any, status: int = 200) -> web.Response:
    """`data` (anything msgspec encodes) as JSON that browsers do not cache."""
    body = msgspec.json.encode(data)
    return web.Response(status=status, body=body, content_type="application/json")


@web.middleware
async def _errors(request: web.Request, handler: Handler) -> web.StreamResponse:
    try:
        return await handler(request)
    except BikepedError as error:
        return json_answer({"error": " ".join(str(error).split())}, 400)
    except (web.HTTPException, asyncio.CancelledError, ConnectionError):
        raise
    except Exception:
        log.exception("web: %s %s failed", request.method, request.path)
        return json_answer({"error": "this is a bug in bikeped: its log says more"}, 500)


async def _set_security_headers(_request: web.Request, response: web.StreamResponse) -> None:
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)
    response.headers.setdefault(hdrs.CACHE_CONTROL, "no-store")
    response.headers.popall(hdrs.SERVER, None)


def _load_static(folder: Path) -> dict[str, _File]:
    """The files of `folder`/static by name: what is not here is not served, whatever the path."""
    files = {}
    for path in (folder / "static").glob("[!.]*"):
        if path.suffix in _TYPES:
            data = path.read_bytes()
            etag = hashlib.sha256(data).hexdigest()[:20]
            files[path.name] = _File(data, _TYPES[path.suffix], etag)
    return files


async def _static(request: web.Request) -> web.StreamResponse:
    name = request.match_info["name"]
    file = request.app[_FILES].get("icon.svg" if name == "favicon.ico" else name)
    if file is None:
        raise web.HTTPNotFound(text="There is no such file.")
    # Browsers revalidate each time: after an update a page must not run on the old scripts.
    headers = {hdrs.ETAG: f'"{file.etag}"', hdrs.CACHE_CONTROL: "no-cache"}
    if any(tag.value == file.etag for tag in request.if_none_match or ()):
        return web.Response(status=304, headers=headers)
    charset = None if file.content_type.startswith("image/") else "utf-8"
    return web.Response(
        body=file.data, content_type=file.content_type, charset=charset, headers=headers
    )


def _page(request: web.Request, page: Page, status: int = 200) -> web.Response:
    """`page` inside the common frame."""
    folders = page.folder / "templates", WEB_FOLDER / "templates"
    pages = request.app[_PAGES]
    text = render("frame.html", *folders, pages=pages, version=__version__, **vars(page))
    return web.Response(status=status, text=text, content_type="text/html")


async def _redirect(path: str, _request: web.Request) -> web.StreamResponse:
    raise web.HTTPFound(path)


# --- login

_LOGIN = Page("/login", "Log in", "Log in", "login.html", scripts=("login.js",))
_REFUSED = Page("/login", "Log in", "Log in: not the token", "login-refused.html")
_WAIT = Page("/login", "Log in", "Log in: please wait", "login-wait.html")


def _answer_without_session(request: web.Request) -> web.Response:
    """Takes the token of a link, or shows the login page; HTTPUnauthorized for programs."""
    accept = request.headers.get(hdrs.ACCEPT, "")
    if request.method != hdrs.METH_GET or "text/html" not in accept:
        raise web.HTTPUnauthorized(
            text="A token is needed: log in, or send Authorization: Bearer TOKEN.",
            headers={hdrs.WWW_AUTHENTICATE: "Bearer"},
        )
    if "token" not in request.query:
        return _page(request, _LOGIN, 401)
    return _try_login(request, request.query["token"], request.path)


def _try_login(request: web.Request, token: str, path: str) -> web.Response:
    """Starts a session that leads to `path`, or shows the page that says why not."""
    try:
        check_token(request.app[_POLICY], request.app[_FAILED_LOGINS], request, token)
    except web.HTTPTooManyRequests as error:
        answer = _page(request, _WAIT, error.status)
        answer.headers[hdrs.RETRY_AFTER] = error.headers[hdrs.RETRY_AFTER]
        return answer
    except web.HTTPUnauthorized as error:
        return _page(request, _REFUSED, error.status)
    return _start_session(request, path)


def _start_session(request: web.Request, path: str) -> web.Response:
    """Sets the session cookie and leads on to `path`.

    By a page, not a redirect: a browser that follows a link on another site (in a mail) does not
    send a SameSite=Strict cookie along the redirects that began there.
    """
    text = render("welcome.html", WEB_FOLDER / "templates", target=_local(path))
    answer = web.Response(text=text, content_type="text/html")
    cookie = request.app[_POLICY].new_cookie(time.time())
    flags: Any = {"httponly": True, "samesite": "Strict", "secure": request.secure}
    answer.set_cookie(COOKIE, cookie, max_age=SESSION_S, **flags)
    return answer


async def _login_form(request: web.Request) -> web.Response:
    return _page(request, _LOGIN)


async def _log_in(request: web.Request) -> web.Response:
    if request.content_type.startswith("multipart/"):  # the login page's form is not
        raise web.HTTPUnsupportedMediaType(text="Send the form as the login page does.")
    form = await request.post()
    return _try_login(request, str(form.get("token", "")), str(form.get("next", "/")))


async def _log_out(_request: web.Request) -> web.StreamResponse:
    answer = web.HTTPSeeOther("/login")
    answer.del_cookie(COOKIE, path="/")
    raise answer


async def _session(request: web.Request) -> web.StreamResponse:
    """Whether the visitor has a session already."""
    return json_answer({"let_in": request.app[_POLICY].has_session(request)})


def _local(path: str) -> str:
    """`path` if it is one of this server, else the first page."""
    fine = re.fullmatch(r"/(?![/\\])[\w\-./]*", path, re.ASCII)
    return path if fine and ".." not in path else "/"

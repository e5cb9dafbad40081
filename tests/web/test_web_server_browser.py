"""The common frame and the login in a real browser."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
from aiohttp import web
from playwright.sync_api import Error, expect
from web_fakes import DESKTOP, LOCKED, OPEN, PHONE, TOKEN

from bikeped.web.server import Page, add_page, make_application

EMPTY = '<!doctype html><title>x</title><link rel="icon" href="data:,">'


def add_two(app: web.Application) -> None:
    add_page(app, Page("/", "Live", "Live", "login-wait.html"))
    add_page(app, Page("/align", "Align", "Align", "login-refused.html"))


@pytest.fixture
def url(serve: Any) -> str:
    return serve(partial(make_application, OPEN, add_two))


@pytest.fixture
def locked(serve: Any) -> str:
    return serve(partial(make_application, LOCKED, add_two))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("viewport", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_the_frame_is_accessible_in_each_look(url, open_page, assert_accessible, viewport, scheme):
    page = open_page(url, viewport, scheme)
    assert_accessible(page)
    assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(244, 245, 243)" if scheme == "light" else "rgb(16, 20, 23)")


def test_the_keyboard_reaches_everything(url, open_page):
    page = open_page(url)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the content"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    page.goto(url)
    found = []
    for _ in range(4):
        page.keyboard.press("Tab")
        found.append(page.evaluate("document.activeElement.textContent.trim()"))
    assert found[:3] == ["Skip to the content", "Live", "Align"]
    assert page.get_attribute("nav a[aria-current]", "href") == "/"


def test_the_colours_are_chosen_and_remembered(url, open_page):
    page = open_page(url)
    for mode in ("light", "dark", None, "light", "dark"):
        page.click("#theme")
        assert page.evaluate("document.documentElement.dataset.theme ?? null") == mode
    expect(page.locator("#announcer")).to_have_text("Colours: dark")
    page.reload()
    assert page.get_attribute("html", "data-theme") == "dark"
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(16, 20, 23)"
    page.goto(f"{url}/align")
    assert page.get_attribute("html", "data-theme") == "dark"


@pytest.mark.parametrize(
    "attempt",
    [
        "document.body.insertAdjacentHTML('beforeend', '<b>x</b>')",
        "document.body.innerHTML = '<b>x</b>'",
        "document.createElement('script').text = 'window.bad = 1'",
        "document.createElement('script').src = '//evil.example/x.js'",
        "new DOMParser().parseFromString('<b>x</b>', 'text/html')",
    ],
)
def test_the_policy_lets_no_text_become_markup(url, open_page, attempt, page_errors):
    page = open_page(url)
    with pytest.raises(Error, match=r"Trusted(HTML|Script)"):
        page.evaluate(attempt)
    assert page.locator("body > b").count() == 0
    page_errors(page).clear()


def test_log_in_with_a_wrong_and_then_the_right_token(
    locked, open_page, assert_accessible, page_errors
):
    page = open_page(f"{locked}/align", PHONE)
    assert page.title() == "Log in · bikeped"
    assert_accessible(page)
    assert page.evaluate("document.activeElement.id") == "token"
    page.keyboard.type("not-the-token")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=Not the token")
    assert_accessible(page)
    page.goto(f"{locked}/align")
    page.fill("#token", TOKEN)
    page.keyboard.press("Enter")
    page.wait_for_url(f"{locked}/align")
    expect(page).to_have_title("Align · bikeped")
    assert page.evaluate("document.cookie") == ""  # no script can read it
    page.goto(f"{locked}/?token={TOKEN}")
    assert page.url == f"{locked}/"
    # A browser says aloud that it was asked for a token.
    assert all("401" in line for line in page_errors(page))
    page_errors(page).clear()


def test_a_link_with_the_token_opens_the_page_and_leaves_no_token_behind(locked, open_page):
    page = open_page(f"{locked}/align?token={TOKEN}")
    page.wait_for_url(f"{locked}/align")
    assert page.title() == "Align · bikeped"
    page.reload()
    assert page.title() == "Align · bikeped"
    assert TOKEN not in page.content()


def test_a_visitor_from_another_site_is_recognised(locked, serve, open_page, page_errors):
    """The browser withholds the cookie from a link elsewhere; our own page then asks again."""

    def elsewhere() -> web.Application:
        app = web.Application()

        async def link(_request: web.Request) -> web.Response:
            text = f'{EMPTY}<a href="{locked}/align">go</a>'
            return web.Response(text=text, content_type="text/html")

        app.router.add_get("/", link)
        return app

    other = serve(elsewhere).replace("127.0.0.1", "localhost")  # another site to a browser
    page = open_page(f"{locked}/?token={TOKEN}")
    page.wait_for_url(f"{locked}/")
    page.goto(other)
    page.click("text=go")
    expect(page).to_have_title("Align · bikeped")
    page_errors(page).clear()  # the first answer was 401


def test_a_foreign_page_can_neither_read_nor_embed(url, serve, open_page, page_errors):
    def elsewhere() -> web.Application:
        app = web.Application()

        async def page(_request: web.Request) -> web.Response:
            return web.Response(text=f"{EMPTY}<iframe></iframe>", content_type="text/html")

        app.router.add_get("/", page)
        return app

    page = open_page(serve(elsewhere).replace("127.0.0.1", "localhost"))
    for init in ("{}", "{method: 'POST', body: 'x'}", "{mode: 'no-cors'}"):
        got = page.evaluate(
            f"fetch('{url}/static/ui.js', {init}).then(a => a.status, e => 'refused')"
        )
        assert got == "refused"
    got = page.evaluate(
        "address => new Promise(done => { const i = new Image(); i.onload = () => done('shown');"
        " i.onerror = () => done('refused'); i.src = address })",
        f"{url}/static/icon.svg",
    )
    assert got == "refused"
    page.evaluate("address => { document.querySelector('iframe').src = address }", url)
    page.wait_for_load_state("networkidle")
    assert "bikeped" not in " ".join(frame.title() for frame in page.frames)
    page_errors(page).clear()

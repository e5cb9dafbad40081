"""The align page in a real browser, from marks in a picture to config.yaml."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from align_scene import HEIGHT_M, ORANGE, PITCH_DEG, Scene, draw_scene
from playwright.sync_api import Page, expect
from web_fakes import OPEN, PHONE

from bikeped.config.load import load_config
from bikeped.web.align import add_align
from bikeped.web.server import make_application


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return draw_scene(tmp_path_factory.mktemp("drawn"))


@pytest.fixture
def scene(drawn: Scene, tmp_path: Path) -> Scene:
    """The drawn picture with a configuration of the test's own."""
    for file in drawn.config.parent.iterdir():
        if file.suffix in (".yaml", ".json"):
            (tmp_path / file.name).write_bytes(file.read_bytes())
    return Scene(
        tmp_path / "config.yaml", drawn.jpeg, drawn.crosses_px, drawn.distances_m, drawn.rights_m
    )


@pytest.fixture
def align(scene: Scene, serve: Callable[..., str], open_page: Callable[..., Page]):
    """Opens the page over the scene; keywords go to `open_page` (`live` to the page)."""

    def open_align(live: bool = False, **options) -> Page:
        loaded = load_config(scene.config)
        url = serve(
            lambda: make_application(
                OPEN, lambda app: add_align(app, loaded, lambda: scene.jpeg, live=live)
            )
        )
        page = open_page(f"{url}/align", **options)
        page.wait_for_selector("html[data-ready=align]")
        expect(page.locator("#ten-figure")).to_have_text("10.00 m")
        return page

    return open_align


def view(page: Page) -> tuple[float, float, float, float, float]:
    """Scale and offset of the picture on the screen, and the stage's corner."""
    scale, left, top, x, y = page.evaluate(
        """() => { const s = document.querySelector('#stage'), b = s.getBoundingClientRect();
        return [+s.dataset.scale, +s.dataset.left, +s.dataset.top, b.left, b.top]; }"""
    )
    return scale, left, top, x, y


def on_screen(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where the middle of a picture's pixel is on the screen."""
    scale, left, top, x, y = view(page)
    return (u + 0.5) * scale + left + x, (v + 0.5) * scale + top + y


def zoom_to(page: Page, u: float, v: float, scale: float) -> None:
    """Turns the wheel over a pixel until it is that large."""
    page.locator("#all").click()
    page.wait_for_function("() => +document.querySelector('#stage').dataset.scale < 0.9")
    for _ in range(40):
        x, y = on_screen(page, u, v)
        page.mouse.move(x, y)
        if view(page)[0] >= scale:
            return
        before = view(page)[0]
        page.mouse.wheel(0, -500)
        page.wait_for_function(
            "s => +document.querySelector('#stage').dataset.scale > s", arg=before
        )
    raise AssertionError("the wheel does not zoom")


def set_marks(page: Page, scene: Scene) -> None:
    """Zooms to each cross, clicks on it, and types what the tape says."""
    for (u, v), distance, right in zip(
        scene.crosses_px.tolist(), scene.distances_m, scene.rights_m, strict=True
    ):
        zoom_to(page, u, v, 3.0)
        page.get_by_role("button", name="Add mark").click()
        page.mouse.click(*on_screen(page, u, v))
        page.get_by_role("button", name="Add mark").click()
        page.get_by_label("Distance, m", exact=True).last.fill(str(distance))
        page.get_by_label("To the right, m").last.fill(str(right))


def test_four_marks_give_height_and_pitch_and_are_saved(align, scene: Scene) -> None:
    """2 cm and 0.2 degrees, from mouse clicks on a drawn scene and the tape's figures."""
    before = scene.config.read_text()
    page = align()
    set_marks(page, scene)
    page.get_by_role("button", name="Fit to the marks").click()
    expect(page.locator("#fit-answer .verdict")).to_contain_text("Height 4.2")
    height = float(
        page.get_by_label("Height", exact=True).and_(page.locator("[type=number]")).input_value()
    )
    pitch = float(page.locator("#dial-pitch_deg").input_value())
    assert height == pytest.approx(HEIGHT_M, abs=0.02)
    assert pitch == pytest.approx(PITCH_DEG, abs=0.2)
    off = page.locator("#fit-answer tbody td:last-child").all_inner_texts()
    assert len(off) == 8
    assert all(abs(float(text.replace("−", "-"))) < 6 for text in off)
    expect(page.locator("#changes tbody tr")).to_have_count(2)
    page.get_by_role("button", name="Save").click()
    expect(page.locator("#saved")).to_contain_text("Saved into")
    camera = load_config(scene.config).config.camera
    assert (camera.height_m, camera.pitch_deg) == (height, pitch)
    after = scene.config.read_text()
    differ = [
        (a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b
    ]
    assert [a.split(":")[0].strip() for a, _ in differ] == ["height_m", "pitch_deg"]
    [backup] = scene.config.parent.glob("config.yaml.*.bak")
    assert backup.read_text() == before
    expect(page.locator("#no-changes")).to_be_visible()
    page.get_by_role("button", name="Undo").click()
    assert page.locator("#dial-height_m").input_value() == "3.6576"


def test_the_picture_is_drawn_where_its_pixels_are(align, scene: Scene) -> None:
    page = align()
    page.get_by_text("Lines shown").click()
    for box in page.locator("#kinds input").all():
        box.uncheck()
    page.get_by_text("Lines shown").click()
    for u, v in scene.crosses_px.tolist():
        zoom_to(page, u, v, 5.0)
        page.mouse.move(0, 0)
        x, y = on_screen(page, u, v)
        shot = page.screenshot(clip={"x": round(x) - 1, "y": round(y) - 1, "width": 3, "height": 3})
        colour = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)[1, 1, ::-1]
        assert np.abs(colour.astype(int) - ORANGE).max() < 40


def test_sliders_and_steps_move_the_grid_and_what_reads_10_m(align) -> None:
    page = align()
    expect(page.locator("#dial-height_m-note")).to_contain_text(
        "+0.1 m moves a 10 m mark by +27 cm"
    )
    expect(page.locator("#dial-radius_px-note")).to_contain_text("overrides the focal length in")
    height = page.locator("#dial-height_m")
    height.fill("4.0234")  # 10 % more
    expect(page.locator("#ten-figure")).to_have_text("11.00 m")
    page.get_by_role("button", name="Height: more").click()
    assert float(height.input_value()) == pytest.approx(4.03)
    page.get_by_role("button", name="Coarse").click()
    height.press("ArrowUp")
    assert float(height.input_value()) == pytest.approx(4.1)
    slider = page.get_by_label("Pitch, slider")
    slider.focus()
    slider.press("ArrowLeft")
    assert page.locator("#dial-pitch_deg").input_value() == "-1"
    expect(page.locator("#changes tbody tr")).to_have_count(2)
    page.get_by_role("button", name="Back to the file").click()
    expect(page.locator("#ten-figure")).to_have_text("10.00 m")
    page.locator("#dial-pitch_deg").fill("45")  # looks up: the 10 m pixel is in the sky now
    expect(page.locator("#ten-text")).to_contain_text("above the horizon")


def test_numbers_that_overtake_an_answer_are_asked_for_next(align) -> None:
    """One question at a time; what was set meanwhile is asked in one, and is what stays."""
    page = align()
    asked, held = [], []

    def pass_on(route) -> None:
        asked.append(route.request.post_data_json["values"]["height_m"])
        if len(asked) == 1:
            held.append(route)
        else:
            route.continue_()

    page.route("**/align/grid", pass_on)
    height = page.locator("#dial-height_m")
    with page.expect_request("**/align/grid"):
        height.fill("5")
    for value in ("6", "7", "7.31520"):
        height.fill(value)
    held[0].continue_()
    expect(page.locator("#ten-figure")).to_have_text("20.00 m")
    assert asked == [5, 7.3152]


def test_marks_by_keyboard_alone(align) -> None:
    page = align()
    page.locator("#stage").focus()
    page.keyboard.press("m")
    pin = page.locator(".pin")
    expect(pin).to_have_attribute("aria-label", re.compile(r"Mark 1, .*horizon|Mark 1, reads"))
    pin.focus()
    before = page.evaluate("() => JSON.parse(localStorage['bikeped-align']).marks[0]")
    for keys in ("ArrowDown", "Shift+ArrowDown", "Control+ArrowDown", "ArrowRight"):
        page.keyboard.press(keys)
    after = page.evaluate("() => JSON.parse(localStorage['bikeped-align']).marks[0]")
    assert after["v"] - before["v"] == pytest.approx(11.1)
    assert after["u"] - before["u"] == pytest.approx(1)
    for _ in range(12):
        page.keyboard.press("Shift+ArrowDown")
    expect(pin).to_have_attribute("aria-label", re.compile(r"Mark 1, reads \d"))
    page.keyboard.press("Enter")
    expect(page.get_by_label("Distance, m", exact=True)).to_be_focused()
    page.keyboard.type("10")
    page.get_by_role("button", name="Fit to the marks").click()
    expect(page.locator("#fit-answer")).to_contain_text("add 1 more")
    page.reload()  # a phone drops pages: the mark is still there
    page.wait_for_selector("html[data-ready=align]")
    expect(page.get_by_label("Distance, m", exact=True)).to_have_value("10")
    pin.focus()
    page.keyboard.press("Delete")
    expect(pin).to_have_count(0)


def test_a_mark_is_dragged_under_a_loupe_and_the_picture_beside_it(align, scene: Scene) -> None:
    page = align()
    u, v = scene.crosses_px[1].tolist()
    zoom_to(page, u, v, 1.5)
    page.get_by_role("button", name="Add mark").click()
    page.mouse.click(*on_screen(page, u - 30, v))
    x, y = on_screen(page, u - 30, v)
    page.mouse.move(x + 5, y + 5)  # takes hold beside its middle: it must not jump
    page.mouse.down()
    page.mouse.move(x + 30, y + 5)
    expect(page.locator("#loupe")).to_be_visible()
    scale = view(page)[0]
    page.mouse.move(x + 5 + 30 * scale, y + 5)
    page.mouse.up()
    expect(page.locator("#loupe")).to_be_hidden()
    mark = page.evaluate("() => JSON.parse(localStorage['bikeped-align']).marks[0]")
    assert (mark["u"], mark["v"]) == (pytest.approx(u, abs=1.1), pytest.approx(v, abs=1.1))
    left = view(page)[1]
    page.mouse.move(x - 120, y - 100)
    page.mouse.down()
    page.mouse.move(x - 70, y - 100, steps=4)
    page.mouse.up()
    page.wait_for_function("l => +document.querySelector('#stage').dataset.left > l + 20", arg=left)
    expect(page.locator(".pin")).to_have_count(1)  # a pan sets no mark


def test_two_fingers_zoom_on_a_phone(align) -> None:
    page = align(viewport=PHONE, has_touch=True, is_mobile=True)
    before = view(page)[0]
    touch = page.context.new_cdp_session(page)
    middle = 200
    for kind, reach in (("Start", 30), ("Move", 60), ("Move", 90)):
        points = [
            {"x": 195 - reach, "y": middle, "id": 1},
            {"x": 195 + reach, "y": middle, "id": 2},
        ]
        touch.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.wait_for_function(
        "b => +document.querySelector('#stage').dataset.scale > 2 * b", arg=before
    )
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")


def test_marks_go_out_to_a_file_and_come_back(align, scene: Scene, tmp_path: Path) -> None:
    page = align()
    set_marks(page, scene)
    with page.expect_download() as download:
        page.get_by_role("button", name="Export marks").click()
    file = tmp_path / "points.json"
    download.value.save_as(file)
    data = json.loads(file.read_text())
    assert [mark["distance_m"] for mark in data["marks"]] == list(scene.distances_m)
    page.get_by_role("button", name="Delete all").click()
    expect(page.locator(".pin")).to_have_count(0)
    page.set_input_files("#import-file", file)
    expect(page.locator(".pin")).to_have_count(4)
    page.get_by_role("button", name="Fit to the marks").click()
    expect(page.locator("#fit-answer .verdict")).to_contain_text("Height 4.2")


def test_another_hand_in_the_file_is_said(align, scene: Scene, page_errors) -> None:
    page = align()
    page.locator("#dial-height_m").fill("5")
    scene.config.write_text(scene.config.read_text() + "\n# somebody was here\n")
    page.get_by_role("button", name="Save").click()
    expect(page.locator("#saved")).to_contain_text("changed after this page was opened")
    assert load_config(scene.config).config.camera.height_m == 3.6576
    page_errors(page).clear()  # the browser's own line about status 409
    page.get_by_role("button", name="Open the page again").click()
    page.wait_for_selector("html[data-ready=align]")


@pytest.mark.parametrize(("scheme", "size"), [("light", "phone"), ("dark", "desktop")])
def test_accessible(align, scene: Scene, assert_accessible, scheme: str, size: str) -> None:
    page = align(live=True, scheme=scheme, **({"viewport": PHONE} if size == "phone" else {}))
    page.get_by_role("button", name="Add mark").click()
    page.get_by_role("button", name="Set here").click()
    page.get_by_text("Distances between marks").click()
    page.get_by_text("Lines shown").click()
    page.get_by_text("Optical centre, heading").click()
    page.locator("#dial-height_m").fill("5")
    expect(page.locator("#changes")).to_be_visible()
    assert_accessible(page)
    page.get_by_role("button", name="New picture").click()
    page.get_by_role("button", name="Save").click()
    expect(page.locator("#saved")).to_contain_text("systemctl restart bikeped")
    expect(page.locator("#save-why")).to_contain_text("reads the file when it starts")

"""The test bench in a real browser: looked at, changed, drawn on, contested, exported."""

from __future__ import annotations

import json
import re

import pytest
from playwright.sync_api import Page, expect
from testbench_fakes import BASE, LOADED, MARKUP, OWN, SCENARIOS, bench, pages, post
from web_fakes import PHONE

from bikeped.cli.main import main
from bikeped.lab.scenarios.scenario import load_scenario, parse_scenario
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.lab.testbench.export import render_report


@pytest.fixture
def testbench(serve, open_page):
    """Opens the page; `link` is what follows its #. The page's `url` is that of the server."""

    def open_bench(link: str = "", **options) -> Page:
        page = open_page(serve(pages) + "/testbench" + (f"#{link}" if link else ""), **options)
        settled(page)
        return page

    return open_bench


def settled(page: Page) -> None:
    """Waits until nothing is being computed."""
    page.wait_for_selector("html[data-ready=testbench]")
    page.wait_for_selector("#tb[data-scenario=idle][data-suite=idle]")


def slide(page: Page, key: str, value: float) -> None:
    """Moves a slider, in whatever group it is."""
    slider = page.locator(f'input[data-key="{key}"]')
    slider.evaluate("node => { node.closest('details').open = true }")
    slider.fill(str(value))


def moment(page: Page) -> int:
    return int(page.locator("#track").get_attribute("aria-valuenow") or -1)


def test_the_page_says_why_the_light_is_red(testbench):
    page = testbench()
    expect(page.locator("#headline")).to_have_text(
        re.compile(
            r"^The light is red: a cyclist and a pedestrian are \d+\.\d\sm apart and getting"
        )
    )
    expect(page.locator("#lamp")).to_have_attribute("data-state", "ALERT")
    expect(page.locator("#sentence")).to_have_text(
        re.compile(r"^ALERT: cyclist \d .*pairwise\)\.$")
    )
    expect(page.locator(".fl-exit.lit")).to_have_text(re.compile("Alert"))
    assert page.locator(".fl-tests .pass").count() == 5
    hashes = page.locator("#provenance code").evaluate_all("all => all.map(n => n.title)")
    assert all(re.fullmatch("[0-9a-f]{64}", one) for one in hashes)
    assert len(page.locator("#scenario option").all()) == len(SCENARIOS)
    drawn = "c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(v => v > 0)"
    for canvas in ("#plan", "#timeline"):
        assert page.locator(canvas).evaluate(drawn)


def test_the_keyboard_scrubs_and_the_diagram_follows(testbench, until):
    page = testbench("scenario=Swerving%20Cyclist")
    track = page.locator("#track")
    track.focus()
    for key, want in (("Home", 0), ("ArrowRight", 1), ("Shift+ArrowRight", 31), ("ArrowLeft", 30)):
        track.press(key)
        assert moment(page) == want
    track.press("End")
    last = moment(page)
    assert last == int(track.get_attribute("aria-valuemax") or 0)
    assert "11.13 seconds" in (track.get_attribute("aria-valuetext") or "")
    track.press("Home")
    track.press("ArrowRight")  # a track counts from its second detection on
    expect(page.locator("#lamp")).to_have_attribute("data-state", "SAFE")
    expect(page.locator(".fl-exit.lit")).to_have_text(re.compile("Safe"))
    expect(page.locator("#headline")).to_have_text(re.compile("^The light is green"))
    page.click("#to-onset")
    expect(page.locator("#lamp")).to_have_attribute("data-state", "ALERT")
    track.press(" ")
    expect(page.locator("#play")).to_have_attribute("aria-pressed", "true")
    until(page, f"document.querySelector('#track').ariaValueNow > {moment(page) + 3}")
    track.press(" ")
    expect(page.locator("#play")).to_have_attribute("aria-pressed", "false")


def test_the_mouse_scrubs(testbench):
    page = testbench()
    box = page.locator("#timeline").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] * 0.3, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] - 14, box["y"] + 40, steps=5)
    page.mouse.up()
    assert moment(page) == int(page.locator("#track").get_attribute("aria-valuemax") or 0)


def test_a_slider_reruns_scenario_and_suite(testbench):
    page = testbench("scenario=Wheelchair%20User")
    url = page.url.partition("/testbench")[0]
    before = page.locator("#figures tbody").inner_text()
    slide(page, "decision.d_max_m", 9)
    settled(page)
    told = post(
        url, "/testbench/scenario", {"bench": bench("Wheelchair User", decision={"d_max_m": 9.0})}
    )
    sensitivity = told["sides"][0]["metrics"]["sensitivity"]
    expect(page.locator("#figures tbody")).to_contain_text(f"{100 * sensitivity:.1f}")
    assert page.locator("#figures tbody").inner_text() != before
    expect(page.locator(".su-verdict")).to_contain_text("fails: sensitivity over actionable frames")
    expect(page.locator(".su-changes")).to_contain_text("decision.d_max_m 24.8 → 9")
    expect(page.locator(".kn-mark").first).to_have_text("1 changed")
    expect(page.locator("#suite pre")).to_contain_text("--set decision.d_max_m=9.0")
    measures = page.evaluate("performance.getEntriesByType('measure').map(e => e.name)")
    assert {"bench:scenario", "bench:suite"} <= set(measures)
    page.click("#reset")
    settled(page)
    assert page.locator("#figures tbody").inner_text() == before
    expect(page.locator(".su-verdict")).to_contain_text("holds all gates")


def test_of_many_quick_changes_the_last_one_holds(testbench, until):
    page = testbench()
    page.locator('input[data-key="decision.d_max_m"]').evaluate(
        """node => { for (let v = 5; v <= 20; v += 0.5) {
             node.value = v; node.dispatchEvent(new Event("input", {bubbles: true})); } }"""
    )
    settled(page)
    expect(page.locator("#suite pre")).to_contain_text("decision.d_max_m=20")
    until(page, "location.hash.includes('decision.d_max_m=20')")


def test_every_control_gives_an_answer(testbench):
    page = testbench("scenario=Cyclist%20Abort&perception.trials=2")
    page.locator(".kn-group").evaluate_all("all => all.forEach(d => { d.open = true })")
    page.get_by_label("detection", exact=True).select_option("0")
    page.get_by_label("detection", exact=True).select_option(label="a fixed share")
    page.get_by_label("a second camera", exact=True).check()
    for control in page.locator('.kn:not([hidden]) input[type="checkbox"]').all():
        control.click()
    settled(page)
    for slider in page.locator('.kn:not([hidden]) input[type="range"]:not([disabled])').all():
        slider.press("PageUp")
        slider.press("ArrowLeft")
    settled(page)
    page.wait_for_selector("#tb[data-trials=idle]")
    expect(page.locator("#toasts .bad")).to_have_count(0)
    assert page.locator(".su-changes li").count() > 10


def test_configurations_side_by_side(testbench, until):
    page = testbench("scenario=U-Turn%20Cyclist")
    page.select_option("#beside-1", "ttc")
    page.select_option("#beside-2", "distance_only")
    settled(page)
    rows = page.locator("#figures tbody tr")
    expect(rows).to_have_count(3)
    expect(rows.nth(1)).to_contain_text("Time to collision")
    page.select_option("#configuration", "narrow")
    settled(page)
    expect(rows.nth(0)).to_contain_text("Narrow")
    # The address is written a moment after a change: that of the last one holds its distance.
    until(page, "location.hash.includes('beside') && location.hash.includes('decision.d_max_m')")
    again = testbench(page.url.partition("#")[2])
    expect(again.locator("#figures tbody tr")).to_have_count(3)
    assert again.locator("#figures").inner_text() == page.locator("#figures").inner_text()


def test_a_contest_goes_to_the_command_line_and_back(testbench, until, tmp_path, capsys):
    page = testbench("scenario=Late%20Turn%20Toward%20Ped")
    slide(page, "decision.memory_frames", 20)
    slide(page, "danger.cpa_radius_m", 3)
    slide(page, "delay.delay_ms", 99)
    settled(page)
    with page.expect_download() as told:
        page.get_by_role("button", name="Save as a file").click()
    file = tmp_path / "challenge.json"
    told.value.save_as(file)
    assert main(["testbench", "contest", str(file), "--json", "-"]) == 0
    data = json.loads(capsys.readouterr().out)
    table = page.locator(".su-figures").inner_text()
    for side in ("before", "after"):
        for key in ("sensitivity", "specificity", "fatigue"):
            assert f"{100 * data[side]['totals'][key]:.1f}" in table
    caption = f"{len(data['changed'])} of {len(SCENARIOS)} scenarios change"
    expect(page.locator(".su-table caption")).to_contain_text(caption)
    # The link, and the file put back into a fresh page, show the same.
    until(page, "location.hash.includes('delay')")
    linked = testbench(page.url.partition("#")[2])
    assert linked.locator("#suite").inner_text() == page.locator("#suite").inner_text()
    fresh = testbench()
    fresh.locator("#open-challenge").set_input_files(file)
    expect(fresh.locator(".su-changes li")).to_have_count(3)
    settled(fresh)
    assert fresh.locator("#suite").inner_text() == page.locator("#suite").inner_text()


def test_a_path_is_drawn_by_mouse_and_by_keyboard_and_saved(testbench, tmp_path):
    page = testbench("scenario=Bike%20Approaches%20Ped")
    page.click("#edit")
    field = page.get_by_label("East of waypoint 1, road user 1")
    before = float(field.input_value())
    box = page.locator("#plan").bounding_box()
    assert box is not None
    # Where a waypoint of the pedestrian's way (x = 5, a little right of the middle) lies: asked of
    # the page's own cursor, from below.
    spot = None
    for y in range(int(box["height"]) - 8, 10, -10):
        for x in (12, 24, 36):
            at = (box["x"] + box["width"] / 2 + x, box["y"] + y)
            page.mouse.move(*at)
            if spot is None and page.locator("#plan").evaluate("c => c.style.cursor") == "grab":
                spot = at
        if spot is not None:
            break
    assert spot is not None
    page.mouse.move(*spot)
    page.mouse.down()
    page.mouse.move(spot[0] + 60, spot[1], steps=4)
    page.mouse.up()
    settled(page)
    assert float(field.input_value()) > before + 1
    expect(page.locator("#scenario option:checked")).to_have_text("✎ Bike Approaches Ped, changed")

    page.get_by_label("Speed of waypoint 2, road user 2").fill("4")
    settled(page)
    page.get_by_role("button", name="Add a pedestrian").click()
    settled(page)
    page.get_by_label("North of waypoint 1, road user 3").fill("-3.5")
    page.get_by_label("Name of the scenario").fill(MARKUP)
    page.get_by_label("Name of the scenario").press("Tab")
    settled(page)
    with page.expect_download() as told:
        page.get_by_role("button", name="Save as a scenario file").click()
    file = tmp_path / told.value.suggested_filename
    told.value.save_as(file)
    saved = load_scenario(file)
    assert saved.name == MARKUP
    assert [a.id for a in saved.agents] == [1, 2, 3]
    assert saved.agents[2].path[0].tolist() == [0.0, 5.0, -3.5]
    step = saved.agents[1].path[1] - saved.agents[1].path[0]
    assert (step[1] ** 2 + step[2] ** 2) ** 0.5 / step[0] == pytest.approx(4, abs=0.02)
    assert saved.agents[0].path[0, 1] == pytest.approx(float(field.input_value()), abs=0.005)
    # Markup in a name is text.
    assert page.title() != "hacked"
    assert page.locator("#tb img, #tb option b").count() == 0
    expect(page.locator("#suite .su-open").filter(has_text="<img")).to_have_count(1)


def test_a_scenario_file_is_opened_and_a_bad_one_explained(testbench, page_errors, tmp_path):
    page = testbench()
    good, bad = tmp_path / "mine.yaml", tmp_path / "bad.yaml"
    good.write_text(OWN)
    bad.write_text(OWN.replace("cyclist", "dragon"))
    page.click("#edit")
    page.locator("#ed-open").set_input_files(good)
    expect(page.locator("#scenario option:checked")).to_have_text("✎ My crossing")
    settled(page)
    assert page.get_by_label("Time of waypoint 2, road user 1").input_value() == "9"
    expect(page.locator("#suite .su-open").filter(has_text="My crossing")).to_have_count(1)
    page.locator("#ed-open").set_input_files(bad)
    expect(page.locator("#ed-error")).to_contain_text("'dragon' is not one of pedestrian, cyclist")
    expect(page.locator("#ed-error")).to_contain_text("bad.yaml")
    page_errors(page).clear()  # the browser's own line about status 400


@pytest.mark.parametrize("look", ["light", "dark", "phone"])
def test_accessible(testbench, assert_accessible, look):
    options = {"viewport": PHONE} if look == "phone" else {"scheme": look}
    page = testbench("scenario=Multiple%20VRUs&decision.d_max_m=12", **options)
    page.click("#edit")
    page.locator("details").evaluate_all("all => all.forEach(d => { d.open = true })")
    assert_accessible(page)
    if look == "phone":
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= PHONE["width"]


def test_the_report_opens_from_the_disk(open_page, assert_accessible, tmp_path):
    named = parse_scenario(OWN.replace("My crossing", json.dumps(MARKUP + "</script>")), "own")
    few = [s for s in SCENARIOS if s.name in ("Bike Approaches Ped", "Bikes Only", "Cyclist Abort")]
    file = tmp_path / "report.html"
    file.write_text(render_report(LOADED, [*few, named], "bikeped testbench export"), "utf-8")
    page = open_page(file.as_uri(), offline=True)
    expect(page.locator("#headline")).to_have_text(re.compile("^The light is red"))
    expect(page.locator("#verdict-section")).to_contain_text("Mean warning budget")
    expect(page.locator("#risks")).to_contain_text("Low light or rain")
    expect(page.locator("#strips canvas")).to_have_count(4)
    page.select_option("#scenario", "Bikes Only")
    expect(page.locator("#headline")).to_have_text("The light is blue: no pedestrian is in view.")
    page.locator("#others").check()
    expect(page.locator("#figures tbody tr")).to_have_count(len(CONFIGURATIONS))
    page.locator("#strips button").nth(3).click()
    page.locator("#track").press("End")
    expect(page.locator("#table-note")).to_contain_text("<img src=x")
    assert page.title() != "hacked"
    assert page.locator("#main img").count() == 0
    assert_accessible(page)


def test_the_report_shows_the_numbers_of_the_command(open_page, tmp_path, capsys):
    file = tmp_path / "report.html"
    few = [s for s in SCENARIOS if s.name in ("Swerving Cyclist", "E-Scooter")]
    file.write_text(render_report(LOADED, few, "again"), "utf-8")
    page = open_page(file.as_uri(), viewport=PHONE)
    page.select_option("#scenario", "Swerving Cyclist")
    suite = Suite.load(few, LOADED)
    row = suite.measure(BASE.decision).scenario_dict(suite.names.index("Swerving Cyclist"))
    expect(page.locator("#figures")).to_contain_text(f"{100 * row['specificity']:.1f}")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]

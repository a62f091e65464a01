"""A page in Chromium: it plays, steps and jumps, says nothing on the console and asks for nothing."""

from __future__ import annotations

import base64
import io
import json
import time

import numpy as np
import pytest
from PIL import Image

import made_bench
import made_story
from browser import AXE, needs_axe, needs_browser, opened, resize, theme
from dsom_jax.view import benched, write_page

pytestmark = needs_browser


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_page(path, made_story.story(made_story.drive(), made_story.drive("segment 2", 1, 80)))
    return path.as_uri()


@pytest.fixture(scope="module")
def chromium():
    with opened() as driver:
        yield driver


@pytest.fixture(scope="module")
def bench_address(tmp_path_factory):
    path, (suite, _, data, worst) = tmp_path_factory.mktemp("bench") / "report.html", made_bench.made()
    benched.write_benchmark(path, suite, data, worst)
    return path.as_uri()


@pytest.fixture
def page(chromium, address):
    yield from visited(chromium, address)


@pytest.fixture
def bench_page(chromium, bench_address):
    yield from visited(chromium, bench_address)


def visited(chromium, address):
    resize(chromium, 1280, 800)
    theme(chromium, "light")
    chromium.get("about:blank")
    chromium.get_log("browser"), chromium.get_log("performance")
    chromium.get(address)
    yield chromium
    # Whatever a test did: no message on the console, no request but for the page itself.
    assert chromium.get_log("browser") == []
    events = [json.loads(entry["message"])["message"] for entry in chromium.get_log("performance")]
    asked = {e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"}
    assert {url.split("#")[0] for url in asked if not url.startswith("data:")} <= {address, "about:blank"}


def click(page, name):
    page.find_element("id", name).click()


def text(page, name):
    return page.find_element("id", name).get_attribute("textContent")


def picture(page):
    """What is drawn on the map (H, W, 4), once it has been drawn."""
    time.sleep(0.2)
    uri = page.execute_script("return document.getElementById('map').toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))).convert("RGBA"))


def brightness(page):
    """Of what is drawn; around it the page shows through."""
    pixels = picture(page)
    return pixels[pixels[..., 3] == 255][:, :3].mean()


def until(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.05)


def test_step_slider_and_numbers(page):
    drive = made_story.drive()
    assert text(page, "update") == "Update 1 of 120" and text(page, "verdict-name") == "lost"
    click(page, "step")
    click(page, "step")
    click(page, "back")
    e_pos, _ = drive.errors()
    assert text(page, "update") == "Update 2 of 120" and text(page, "now-error").startswith(f"{e_pos[1]:.1f} m, 0°")
    assert text(page, "now-lost") == "60.0 %" and text(page, "places").startswith("55.0 % at")
    x, y, _ = drive.estimates[1]
    assert text(page, "now-pose").startswith(f"{x:.2f}, {y:.2f} m")
    for item in page.find_elements("css selector", "[data-key]"):
        assert float(item.get_attribute("data-value")) == made_story.SUMMARY[item.get_attribute("data-key")]


def test_play_and_stop(page):
    page.execute_script("document.getElementById('speed').value = '20'")
    click(page, "play")
    until(lambda: int(text(page, "update").split()[1]) > 4)
    assert text(page, "play") == "Stop"
    click(page, "play")
    here = text(page, "update")
    time.sleep(0.3)
    assert text(page, "update") == here and page.current_url.endswith(f"t={int(here.split()[1]) - 1}")


def test_jumps(page):
    click(page, "next-kidnapping")
    assert text(page, "update") == f"Update {made_story.CARRIED + 1} of 120"
    assert "Carried away" in text(page, "verdict-why")
    for button in page.find_elements("css selector", "#moments button"):
        if "Sure and wrong" in button.text:
            button.click()
    assert text(page, "verdict-name") == "localized" and " m" in text(page, "now-error")
    click(page, "next-worst")
    assert int(text(page, "update").split()[1]) > made_story.CARRIED


def test_layers_can_be_hidden(page):
    click(page, "step")
    whole = picture(page)
    changed = []
    for layer in ("estimate", "truth", "hypotheses", "scan", "particles", "path"):
        click(page, f"layer-{layer}")
        changed.append(int((picture(page) != whole).any(-1).sum()))
        click(page, f"layer-{layer}")
    assert min(changed) > 20 and (picture(page) == whole).all()


def test_follow_and_zoom(page):
    page.execute_script("location.hash = '#t=30'")
    until(lambda: text(page, "update") == "Update 31 of 120")
    whole = picture(page)
    click(page, "zoom-in")
    assert (picture(page) != whole).any()
    click(page, "zoom-fit")
    assert (picture(page) == whole).all()
    click(page, "follow")
    near = picture(page)
    blue = (np.abs(near[..., :3].astype(int) - [0x0B, 0x5C, 0xAD]).sum(-1) < 30).nonzero()
    # The estimate, an arrow of 23 pixels, is in the middle.
    middle = np.array(near.shape[:2]) / 2
    assert (np.abs(np.stack(blue, -1) - middle).max(-1) < 14).sum() > 60


def test_address_and_second_drive(page, address):
    page.get(address + "#d=2&t=61")
    page.refresh()
    assert text(page, "update") == "Update 62 of 80"
    choose = "const s = document.getElementById('drive'); s.value = '0'; s.dispatchEvent(new Event('change'))"
    page.execute_script(choose)
    assert text(page, "update") == "Update 1 of 120"


def test_keys(page):
    from selenium.webdriver import ActionChains, Keys

    page.execute_script("document.getElementById('player').focus()")

    def press(key):
        ActionChains(page).send_keys(key).perform()

    press(Keys.END)
    assert text(page, "update") == "Update 120 of 120"
    press(Keys.ARROW_LEFT)
    press("k")
    assert text(page, "update") == f"Update {made_story.CARRIED + 1} of 120"
    press(" ")
    until(lambda: text(page, "play") == "Stop")
    press(" ")
    press("f")
    assert page.find_element("id", "follow").is_selected()
    # What a screen reader hears.
    press(Keys.HOME)
    assert text(page, "live").startswith("Update 1: lost, probability of being lost 60.0 %")
    assert "Update 1: lost" in page.find_element("id", "map").get_attribute("aria-label")
    assert page.find_element("id", "slider").get_attribute("aria-valuetext") == "update 1 of 120, lost"


def test_worst_runs_of_bench(bench_page):
    """A link in the table leads to the picture of the drive, which is drawn, and has the colours of the theme."""
    link = bench_page.find_elements("css selector", "tbody a[href^='#worst-']")[4]
    place = link.get_attribute("href").split("#")[1]
    link.click()
    chosen = bench_page.find_element("css selector", "li:target")
    top = bench_page.execute_script("return arguments[0].getBoundingClientRect().top", chosen)
    assert chosen.get_attribute("id") == place and 0 <= top < 700
    shades = {}
    for colours in ("light", "dark"):
        theme(bench_page, colours)
        shot = np.asarray(
            Image.open(io.BytesIO(chosen.find_element("tag name", "svg").screenshot_as_png)).convert("RGB")
        )
        shades[colours] = shot.astype(int)
    red, blue = ((np.abs(shades["light"] - colour).sum(-1) < 40).sum() for colour in ([179, 38, 30], [11, 92, 173]))
    assert red > 50 and blue > 20
    assert shades["light"].mean() > 180 > 90 > shades["dark"].mean()


@pytest.mark.parametrize("width", [1280, 390])
def test_bench_is_no_wider_than_the_screen(bench_page, width):
    resize(bench_page, width, 844)
    assert bench_page.execute_script("return document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_wider_than_the_screen(page, width):
    resize(page, width, 844)
    assert page.execute_script("return document.documentElement.scrollWidth") <= width
    narrow = page.find_element("id", "map").rect
    assert narrow["width"] > 0.6 * width and narrow["height"] >= 280


def test_colours_follow_the_theme(page):
    light = brightness(page)
    theme(page, "dark")
    assert light > 200 > 80 > brightness(page)


def test_prints_on_white(page):
    theme(page, "dark")
    pdf = page.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})["data"]
    assert base64.b64decode(pdf)[:5] == b"%PDF-"
    page.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert brightness(page) > 200
    page.execute_script("window.dispatchEvent(new Event('afterprint'))")
    assert brightness(page) < 80


@needs_axe
@pytest.mark.parametrize("colours", ["light", "dark"])
@pytest.mark.parametrize("kind", ["page", "bench_page"])
def test_axe_finds_nothing(request, kind, colours):
    page = request.getfixturevalue(kind)
    theme(page, colours)
    time.sleep(0.3)  # colours that fade over are judged once they are there
    page.execute_script(AXE.read_text())
    found = page.execute_async_script("axe.run().then(arguments[arguments.length - 1])")
    told = [(v["id"], v["help"], [n["html"] for n in v["nodes"]]) for v in found["violations"]]
    assert told == [] and len(found["passes"]) > 20

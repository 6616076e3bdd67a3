"""The page of a reconstruction, as text and in a real browser."""

from __future__ import annotations

import json
import re
from html import unescape

import pytest
from live_browser import LiveBrowser

pytest.importorskip("torch")

PIXELS = "document.querySelector('.surface canvas').toDataURL()"
CAPTION = "document.querySelector('.surface output').textContent"
PLAY = "document.querySelector('.surface [data-does=play]').textContent"
WIDTH = "document.documentElement.scrollWidth"


@pytest.fixture(scope="module")
def page(result, tmp_path_factory):
    return result.report(tmp_path_factory.mktemp("page") / "page.html")


@pytest.fixture(scope="module")
def browser(page, tmp_path_factory):
    with LiveBrowser(page, tmp_path_factory.mktemp("profile")) as browser:
        yield browser
        # The test that reads pixels causes a warning.
        assert [error for error in browser.errors() if "Canvas2D" not in error] == []


def test_the_page_shows_the_images_and_loads_nothing(result, page):
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert all(sentence in unescape(text) for sentence in result.summary())
    # Image, outline and mask; six views around the body.
    assert len(re.findall(r'<img src="data:image/png;base64,[^"]+"', text)) == 3 + 6
    assert text.count("<svg") == 1
    data = json.loads(re.search(r'"application/json">(.*?)</script>', text)[1])
    assert len(data["vertices"]) == len(data["colours"]) == 5


def test_a_clip_shows_its_images(make_result, tmp_path):
    clip = make_result(6)
    text = clip.report(tmp_path / "clip.html").read_text(encoding="utf-8")
    assert "<h1>Quadruped from 6 images</h1>" in text
    assert [f"image {frame}" in text for frame in range(1, 7)] == [1, 0, 1, 1, 0, 1]


def test_the_outline_surrounds_the_body(result, page):
    """Mask and outline agree where the made mask was rendered at θ."""
    path = re.search(r'<path d="([^"]+)"', page.read_text(encoding="utf-8"))[1]
    points = [tuple(map(float, pair)) for pair in re.findall(r"([\d.-]+),([\d.-]+)", path)]
    columns, rows = zip(*points, strict=True)
    inside = result.observation.mask[0] >= 0.5
    for values, axis in ((columns, 0), (rows, 1)):
        (covered,) = inside.any(axis=axis).nonzero()
        assert min(values) == pytest.approx(covered[0], abs=2.5)
        assert max(values) == pytest.approx(covered[-1] + 1, abs=2.5)


def test_draws_play_turn_and_are_chosen(browser):
    browser.position(".surface canvas")
    before = browser.value(PIXELS)
    browser.wait_until(lambda: browser.value(PIXELS) != before)
    browser.click(".surface [data-does=play]")
    browser.wait_until(f"{PLAY} === 'Play'")
    still, caption = browser.value(PIXELS), browser.value(CAPTION)
    assert browser.value(PIXELS) == still
    assert re.fullmatch(r"draw \d+: faces (left|right), (towards|away from) the camera", caption)
    browser.click(".surface [data-draw='4']")
    assert browser.value(CAPTION) != caption
    other = browser.value(PIXELS)
    assert other != still
    x, y = browser.position(".surface canvas")
    browser.mouse(("Pressed", x, y), ("Moved", x + 60, y), ("Released", x + 60, y))
    turned = browser.value(PIXELS)
    assert turned != other
    browser.value("document.querySelector('.surface canvas').focus()")
    browser.press("ArrowUp", 38)
    assert browser.value(PIXELS) != turned


def test_the_page_is_no_wider_than_a_phone(browser):
    browser.call(
        "Emulation.setDeviceMetricsOverride",
        width=390, height=900, deviceScaleFactor=1, mobile=False,
    )  # fmt: skip
    assert browser.value("innerWidth") == 390
    assert browser.value(WIDTH) <= 390

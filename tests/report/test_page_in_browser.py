"""The report in a real browser: animations, controls, camera view and sorting."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from live_browser import LiveBrowser
from made_reports import MadeComparison, filmed_problem

from probmotion.calibration import calibrate
from probmotion.comparison import compare
from probmotion.report.page import write_report
from probmotion.samplers import ExactSampler

FRAME = "Number(document.querySelector('.part .animation input[type=range]').value)"
PIXELS = "[...document.querySelectorAll('.part .animation canvas')].map((each) => each.toDataURL())"
PLAY = "document.querySelector('.part .animation [data-does=play]').textContent"
OUTPUT = "document.querySelector('.part .animation output').textContent"
CAMERA = "document.querySelector('.part .animation [data-does=camera]').ariaPressed"
DATA = "JSON.parse(document.querySelector('.part .animation script').textContent)"
TABLE = "document.querySelector('.part table')"
NAMES = f"[...{TABLE}.tBodies[0].rows].map((row) => row.cells[0].dataset.value)"
SORTED = f"[...{TABLE}.tHead.rows[0].cells].map((cell) => cell.ariaSort)"
SLIDER = ".part .animation input[type=range]"
FRAMES, FPS, OBSERVED = 12, 30, 3
# Frames per second, counted for one second.
RATE = f"""(async () => {{
  let [passed, before, begun, now] = [0, {FRAME}, 0, 0];
  while (now - begun < 1000 || !begun) {{
    now = await new Promise(requestAnimationFrame);
    begun ||= now;
    passed += ({FRAME} - before + {FRAMES}) % {FRAMES};
    before = {FRAME};
  }}
  return (1000 * passed) / (now - begun);
}})()"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Report of a problem with a perspective camera and four samplers, of which one fails."""
    folder = tmp_path_factory.mktemp("report")
    samplers = {"b": 30.0, "c": 4.0, "a": 200.0, "none": None}
    comparison = MadeComparison(folder, [filmed_problem(OBSERVED)], samplers)
    comparison.judge("filmed", b="biased", c="right", a="overconfident")
    settings = {"draws": 10, "chains": 1, "workers": 0, "progress": False}
    calibration = calibrate("gait(frames=4)", ExactSampler(), simulations=10, **settings)
    return write_report(comparison, folder / "report.html", calibration)


@pytest.fixture(scope="module")
def browser(report, tmp_path_factory):
    with LiveBrowser(report, tmp_path_factory.mktemp("profile"), size=(500, 800)) as browser:
        yield browser
        # The test that reads pixels causes a warning.
        assert [error for error in browser.errors() if "Canvas2D" not in error] == []


def all_differ(one, other):
    return not any(a == b for a, b in zip(one, other, strict=True))


@pytest.fixture
def stopped(browser):
    """The browser with a stopped animation and the keyboard focus on it."""
    browser.position(".part .cards")
    browser.value("document.querySelector('.part .cards').focus()")
    browser.press("Home", 36)
    browser.wait_until(f"{PLAY} === 'Play'")
    return browser


def test_animations_play_in_real_time_and_stop(browser):
    browser.position(".part .cards")
    first = browser.value(PIXELS)
    assert len(first) == 3
    browser.wait_until(lambda: all_differ(browser.value(PIXELS), first))
    assert browser.value(PLAY) == "Stop"
    # A busy machine may be slower, and catches up a little.
    assert 0 < browser.value(RATE) < 1.5 * FPS
    browser.value("document.querySelector('.part .cards').focus()")
    browser.press(" ", 32)
    browser.wait_until(f"{PLAY} === 'Play'")
    still = browser.value(PIXELS)
    time.sleep(0.4)
    assert browser.value(PIXELS) == still
    browser.press(" ", 32)
    browser.wait_until(lambda: all_differ(browser.value(PIXELS), still))


def test_keys_and_slider_select_frames(stopped):
    frames = []
    for key, code in (("End", 35), (".", 190), (",", 188), ("Home", 36), (".", 190)):
        stopped.press(key, code)
        frames.append(stopped.value(FRAME))
    assert frames == [11, 11, 10, 0, 1]
    stopped.click(SLIDER, 0.8)
    late, pixels = stopped.value(FRAME), stopped.value(PIXELS)
    assert abs(late - 0.8 * (FRAMES - 1)) <= 1
    assert stopped.value(OUTPUT) == f"frame {late + 1} of {FRAMES}"
    places = [stopped.position(SLIDER, at) for at in (late / (FRAMES - 1), 0.5, 0.2, 0.2)]
    events = ("Pressed", "Moved", "Moved", "Released")
    stopped.mouse(*((event, *place) for event, place in zip(events, places, strict=True)))
    early = stopped.value(FRAME)
    assert abs(early - 0.2 * (FRAMES - 1)) <= 1
    assert all_differ(stopped.value(PIXELS), pixels)
    time.sleep(0.3)
    assert (stopped.value(FRAME), stopped.value(PLAY)) == (early, "Play")
    # The browser itself moves a focused slider.
    stopped.press("Home", 36)
    assert stopped.value(FRAME) == 0


def test_keys_and_dragging_turn_all_skeletons(stopped):
    front = stopped.value(PIXELS)
    keys = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
    for there, back in (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown")):
        stopped.press(there, keys[there])
        assert all_differ(stopped.value(PIXELS), front)
        stopped.press(back, keys[back])
        assert stopped.value(PIXELS) == front
    x, y = stopped.position(".part .animation canvas")
    stopped.mouse(("Moved", x, y), ("Moved", x + 60, y))
    assert stopped.value(PIXELS) == front
    stopped.mouse(("Pressed", x, y), ("Moved", x + 60, y), ("Released", x + 60, y))
    assert all_differ(stopped.value(PIXELS), front)
    with_truth = stopped.value(PIXELS)
    stopped.click(".part .animation [data-does=truth]")
    assert all_differ(stopped.value(PIXELS), with_truth)
    stopped.click(".part .animation [data-does=truth]")
    assert stopped.value(PIXELS) == with_truth


def test_camera_view_shows_the_keypoints_where_the_camera_observed_them(stopped):
    data = stopped.value(DATA)
    problem = filmed_problem(OBSERVED)
    camera, truth = problem.posterior.likelihood.cameras, problem.truth
    middle = truth[:, list(problem.posterior.skeleton.roots)]
    middle[..., 1] = data["middle"]
    shown = camera.project(truth)[0] - camera.project(middle)[0]
    metres = shown * (camera.depth(middle)[0] / camera.focal[0])[..., None]
    stopped.press("c", 67)
    assert stopped.value(CAMERA) == "true"
    # A colour that crossing bones cannot produce.
    stopped.value(
        "document.documentElement.style.setProperty('--seen', '#ff00ff');"
        "window.dispatchEvent(new Event('resize'))"
    )
    canvas = "document.querySelector('.part canvas')"
    width, height = stopped.value(f"[{canvas}.clientWidth, {canvas}.clientHeight]")
    place = width / data["columns"]
    scale = min(place / data["across"], height / data["up"])
    pixels = np.round(np.array([place / 2, height / 2]) + scale * metres).astype(int)
    for frame, points in enumerate(pixels):
        if frame:
            stopped.press(".", 190)
        ringed = stopped.value(f"""{json.dumps(points.tolist())}.map(([x, y]) => {{
          const pen = document.querySelector(".part canvas").getContext("2d");
          const {{ data }} = pen.getImageData(x - 6, y - 6, 13, 13);
          return [...Array(169).keys()].some((n) => data[4 * n + 3] > 100 && data[4 * n] > 170
            && data[4 * n + 1] < 90 && data[4 * n + 2] > 170);
        }})""")
        assert ringed == len(ringed) * [frame < OBSERVED]
    stopped.press("ArrowLeft", 37)
    assert stopped.value(CAMERA) == "false"


def test_tables_are_sorted_by_their_headings(browser):
    assert browser.value(NAMES) == ["b", "c", "a", "none"]
    # Failures have no number and stay last.
    for column, order, state in (
        (3, "c b a none", [None, None, "ascending"]),
        (3, "a b c none", [None, None, "descending"]),
        (1, "a b c none", ["ascending", None, None]),
    ):
        browser.click(f".part table th:nth-child({column}) button")
        assert browser.value(NAMES) == order.split()
        assert browser.value(SORTED) == state


def test_page_fits_its_width_and_shows_the_figures(browser):
    page = "document.documentElement"
    assert browser.value(f"{page}.scrollWidth <= {page}.clientWidth")
    for figure, width in ((".answer img.plot", 200), ("img.calibration", 1000)):
        image = f"document.querySelector('{figure}')"
        browser.position(figure)
        browser.wait_until(f"{image}.complete && {image}.naturalWidth > {width}")


# Rectangle of each part of the first screen, from its top to its bottom, pixels.
PLACES = """Object.fromEntries(["sentences", "featured", "verdicts", "cost"].map((name) => {
  const box = document.querySelector(`.${name}`).getBoundingClientRect();
  return [name, [box.top, box.bottom]];
}))"""


def screen(browser, width, height):
    settings = {"deviceScaleFactor": 1, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=height, **settings)
    browser.value("scrollTo(0, 0)")
    page = "document.documentElement"
    assert browser.value(f"[{page}.scrollWidth, {page}.clientWidth]") == 2 * [width]
    return browser.value(PLACES)


def test_first_screen_contains_sentences_verdicts_plot_and_a_playing_animation(report, tmp_path):
    with LiveBrowser(report, tmp_path, size=(1440, 900)) as browser:
        browser.call("Emulation.setScrollbarsHidden", hidden=True)
        wide = screen(browser, 1440, 900)
        assert all(0 < top < bottom <= 900 for top, bottom in wide.values())
        place = "document.querySelector('.answer input[type=range]').value"
        first = browser.value(place)
        browser.wait_until(lambda: browser.value(place) != first)
        phone = screen(browser, 390, 844)
        assert list(phone) == sorted(phone, key=lambda name: phone[name][0])
        assert all(top < 844 for top, _ in phone.values())
        assert phone["verdicts"][1] <= 844
        # A tap shows the numbers, and Escape hides them.
        browser.click("button.word.right")
        browser.wait_until("document.querySelector(':popover-open table') !== null")
        browser.press("Escape", 27)
        browser.wait_until("document.querySelector(':popover-open') === null")
        assert browser.errors() == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_print_shows_skeletons_that_were_never_on_the_screen(report, tmp_path, scheme):
    with LiveBrowser(report, tmp_path) as browser:
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.call("Emulation.setEmulatedMedia", features=features)
        blank = "[...document.querySelectorAll('canvas')].filter((each) => each.width === 300)"
        assert browser.value(f"{blank}.length") > 0
        browser.value("window.dispatchEvent(new Event('beforeprint'))")
        assert browser.value(f"{blank}.length") == 0
        # Ink on white paper.
        paper = "getComputedStyle(document.documentElement).getPropertyValue('--paper')"
        assert browser.value(paper) == "#ffffff"
        browser.value("window.dispatchEvent(new Event('afterprint'))")
        assert (browser.value(paper) == "#ffffff") == (scheme == "light")


def test_nothing_moves_by_itself_with_reduced_motion(report, tmp_path):
    with LiveBrowser(report, tmp_path, "--force-prefers-reduced-motion") as browser:
        browser.position(".part .cards")
        browser.wait_until(f"{OUTPUT} === 'frame 1 of {FRAMES}'")
        pixels = browser.value(PIXELS)
        time.sleep(0.4)
        assert (browser.value(PLAY), browser.value(PIXELS)) == ("Play", pixels)
        browser.click(".part .animation [data-does=play]")
        browser.wait_until(lambda: all_differ(browser.value(PIXELS), pixels))
        assert browser.errors() == []


def test_report_of_a_comparison_opens_without_errors(tmp_path):
    settings = {"draws": 20, "chains": 2, "out": tmp_path / "out", "workers": 0, "progress": False}
    comparison = compare("gait-monocular(frames=4)", ExactSampler(), **settings)
    with LiveBrowser(comparison.report(tmp_path / "a.html"), tmp_path / "profile") as browser:
        browser.position(".part .cards")
        browser.wait_until(f"{PLAY} === 'Stop'")
        assert browser.value("document.querySelectorAll('.part .animation canvas').length") == 2
        assert browser.errors() == []

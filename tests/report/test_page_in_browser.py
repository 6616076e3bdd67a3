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

FRAME = "Number(document.querySelector('.animation input[type=range]').value)"
PIXELS = "[...document.querySelectorAll('.animation canvas')].map((each) => each.toDataURL())"
PLAY = "document.querySelector('.animation [data-does=play]').textContent"
OUTPUT = "document.querySelector('.animation output').textContent"
CAMERA = "document.querySelector('.animation [data-does=camera]').ariaPressed"
DATA = "JSON.parse(document.querySelector('.animation script').textContent)"
NAMES = "[...document.querySelector('table').tBodies[0].rows].map((r) => r.cells[0].dataset.value)"
SORTED = "[...document.querySelector('table').tHead.rows[0].cells].map((cell) => cell.ariaSort)"
SLIDER = ".animation input[type=range]"
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
    settings = {"draws": 10, "chains": 1, "workers": 0, "progress": False, "out": folder}
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
    browser.position(".cards")
    browser.value("document.querySelector('.cards').focus()")
    browser.press("Home", 36)
    browser.wait_until(f"{PLAY} === 'Play'")
    return browser


def test_animations_play_in_real_time_and_stop(browser):
    browser.position(".cards")
    first = browser.value(PIXELS)
    assert len(first) == 3
    browser.wait_until(lambda: all_differ(browser.value(PIXELS), first))
    assert browser.value(PLAY) == "Stop"
    # A busy machine may be slower, and catches up a little.
    assert 0 < browser.value(RATE) < 1.5 * FPS
    browser.value("document.querySelector('.cards').focus()")
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
    x, y = stopped.position(".animation canvas")
    stopped.mouse(("Moved", x, y), ("Moved", x + 60, y))
    assert stopped.value(PIXELS) == front
    stopped.mouse(("Pressed", x, y), ("Moved", x + 60, y), ("Released", x + 60, y))
    assert all_differ(stopped.value(PIXELS), front)
    with_truth = stopped.value(PIXELS)
    stopped.click(".animation [data-does=truth]")
    assert all_differ(stopped.value(PIXELS), with_truth)
    stopped.click(".animation [data-does=truth]")
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
    canvas = "document.querySelector('canvas')"
    width, height = stopped.value(f"[{canvas}.clientWidth, {canvas}.clientHeight]")
    place = width / data["columns"]
    scale = min(place / data["across"], height / data["up"])
    pixels = np.round(np.array([place / 2, height / 2]) + scale * metres).astype(int)
    for frame, points in enumerate(pixels):
        if frame:
            stopped.press(".", 190)
        ringed = stopped.value(f"""{json.dumps(points.tolist())}.map(([x, y]) => {{
          const pen = document.querySelector("canvas").getContext("2d");
          const {{ data }} = pen.getImageData(x - 3, y - 3, 7, 7);
          return [...Array(49).keys()].some((n) => data[4 * n + 3] > 100 && data[4 * n] > 170
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
        browser.click(f"table th:nth-child({column}) button")
        assert browser.value(NAMES) == order.split()
        assert browser.value(SORTED) == state


def test_page_fits_its_width_and_shows_the_figures(browser):
    page = "document.documentElement"
    assert browser.value(f"{page}.scrollWidth <= {page}.clientWidth")
    for figure, width in (("section img.plot", 300), ("img.calibration", 1000)):
        image = f"document.querySelector('{figure}')"
        browser.position(figure)
        browser.wait_until(f"{image}.complete && {image}.naturalWidth > {width}")


def test_nothing_moves_by_itself_with_reduced_motion(report, tmp_path):
    with LiveBrowser(report, tmp_path, "--force-prefers-reduced-motion") as browser:
        browser.position(".cards")
        browser.wait_until(f"{OUTPUT} === 'frame 1 of {FRAMES}'")
        pixels = browser.value(PIXELS)
        time.sleep(0.4)
        assert (browser.value(PLAY), browser.value(PIXELS)) == ("Play", pixels)
        browser.click(".animation [data-does=play]")
        browser.wait_until(lambda: all_differ(browser.value(PIXELS), pixels))
        assert browser.errors() == []


def test_report_of_a_comparison_opens_without_errors(tmp_path):
    settings = {"draws": 20, "chains": 2, "out": tmp_path / "out", "workers": 0, "progress": False}
    comparison = compare("gait-monocular(frames=4)", ExactSampler(), **settings)
    with LiveBrowser(comparison.report(tmp_path / "a.html"), tmp_path / "profile") as browser:
        browser.position(".cards")
        browser.wait_until(f"{PLAY} === 'Stop'")
        assert browser.value("document.querySelectorAll('.animation canvas').length") == 2
        assert browser.errors() == []

"""The page of a comparison that was run, in a browser with its own clock, mouse and keys."""

from __future__ import annotations

import time
from pathlib import Path

from live_browser import LiveBrowser

from probmotion.calibration import calibrate
from probmotion.comparison import compare
from probmotion.samplers import ExactSampler, MetropolisHastings

FRAME = "Number(document.querySelector('.player input[type=range]').value)"
LOOK = "[...document.querySelectorAll('.player canvas')].map((canvas) => canvas.toDataURL())"
PLAY = "document.querySelector('.player [data-does=play]').textContent"
WORDS = "document.querySelector('.player output').textContent"
ROWS = (
    "[...document.querySelector('table').tBodies[0].rows].map((row) => row.cells[0].dataset.value)"
)
HEAD = "table th:nth-child({}) button"
LAST, FPS = 29, 30
# Frames a second, counted for one: a motion that ends begins anew.
PACE = f"""(async () => {{
  let [passed, before, begun, now] = [0, {FRAME}, 0, 0];
  while (now - begun < 1000 || !begun) {{
    now = await new Promise(requestAnimationFrame);
    begun ||= now;
    passed += ({FRAME} - before + {LAST + 1}) % {LAST + 1};
    before = {FRAME};
  }}
  return (1000 * passed) / (now - begun);
}})()"""


def page(folder: Path) -> Path:
    """Run a comparison and a calibration and write their page."""
    samplers = [ExactSampler(), MetropolisHastings(warmup=200)]
    settings = {"draws": 20, "chains": 2, "out": folder / "out", "workers": 0, "progress": False}
    comparison = compare("gait-monocular", samplers, **settings)
    assert comparison.failures == []
    calibration = calibrate("gait-monocular", samplers[0], simulations=10, **settings)
    return comparison.report(folder / "report.html", calibration)


def all_differ(one: list[str], other: list[str]) -> bool:
    return not any(a == b for a, b in zip(one, other, strict=True))


def plays_by_itself(browser: LiveBrowser) -> None:
    browser.place(".cards")
    begun = browser.value(LOOK)
    assert len(begun) == 3  # reference draws and two samplers
    browser.wait_until(lambda: all_differ(browser.value(LOOK), begun))
    assert browser.value(PLAY) == "Stop"
    # No quicker than it was filmed, but for what a busy machine has to make up for.
    assert 0 < browser.value(PACE) < 1.5 * FPS


def stops_and_goes_on_at_the_space_key(browser: LiveBrowser) -> None:
    browser.click(".player canvas")  # so that keys are its own
    browser.press(" ", 32)
    browser.wait_until(f"{PLAY} === 'Play'")
    still = browser.value(LOOK)
    time.sleep(0.4)
    assert browser.value(LOOK) == still
    browser.press(" ", 32)
    browser.wait_until(lambda: all_differ(browser.value(LOOK), still))


def is_scrubbed(browser: LiveBrowser) -> None:
    assert browser.value(PLAY) == "Stop"
    slider = ".player input[type=range]"
    browser.click(slider, 0.8)
    late, seen = browser.value(FRAME), browser.value(LOOK)
    assert abs(late - 0.8 * LAST) <= 2
    assert browser.value(WORDS) == f"frame {late + 1} of {LAST + 1}"
    browser.mouse(
        ("Pressed", *browser.place(slider, late / LAST)),
        ("Moved", *browser.place(slider, 0.5)),
        ("Moved", *browser.place(slider, 0.2)),
        ("Released", *browser.place(slider, 0.2)),
    )
    early = browser.value(FRAME)
    assert abs(early - 0.2 * LAST) <= 2
    assert all_differ(browser.value(LOOK), seen)
    # A hand on the slider ends the playing.
    time.sleep(0.3)
    assert (browser.value(FRAME), browser.value(PLAY)) == (early, "Play")


def is_turned(browser: LiveBrowser) -> None:
    x, y = browser.place(".player canvas")
    frame, front = browser.value(FRAME), browser.value(LOOK)
    browser.mouse(("Moved", x, y), ("Moved", x + 60, y))
    assert browser.value(LOOK) == front
    browser.mouse(("Pressed", x, y), ("Moved", x + 60, y), ("Released", x + 60, y))
    turned = browser.value(LOOK)
    assert all_differ(turned, front)
    browser.mouse(("Moved", x, y))
    browser.press("ArrowLeft", 37)
    browser.wait_until(lambda: all_differ(browser.value(LOOK), turned))
    assert all_differ(browser.value(LOOK), front)
    assert browser.value(FRAME) == frame


def is_sorted(browser: LiveBrowser) -> None:
    assert browser.value(ROWS) == ["exact", "mh"]
    for column in (1, 2):
        # Exact draws come first by name, and cost less.
        name = browser.value(f"document.querySelector({HEAD.format(column)!r}).textContent")
        assert name.strip() == ("sampler", "seconds")[column - 1]
        for order in (["exact", "mh"], ["mh", "exact"]):
            browser.click(HEAD.format(column))
            assert browser.value(ROWS) == order


def shows_the_calibration(browser: LiveBrowser) -> None:
    picture = "document.querySelector('img.calibration')"
    browser.place("img.calibration")
    browser.wait_until(f"{picture}.complete && {picture}.naturalWidth > 1000")
    assert browser.value(f"{picture}.clientWidth") > 500


def test_a_comparison_plays_stops_turns_and_sorts(tmp_path):
    with LiveBrowser(page(tmp_path), tmp_path / "profile") as browser:
        plays_by_itself(browser)
        stops_and_goes_on_at_the_space_key(browser)
        is_scrubbed(browser)
        is_turned(browser)
        is_sorted(browser)
        shows_the_calibration(browser)
        assert browser.errors() == []

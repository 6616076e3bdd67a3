"""The page of a comparison in a real browser: it plays, turns, sorts and says no error."""

from __future__ import annotations

import html
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from live_browser import browser_command

from probmotion import Cameras, Keypoints2D, MotionDraws, MotionPosterior, seeds
from probmotion.comparison.comparison import Comparison
from probmotion.comparison.results.cell_results import CellResult
from probmotion.comparison.results.failures import Failure
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.stored_problems import StoredProblem, store_problem
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.problem import Problem
from probmotion.report.animations import shown_problems
from probmotion.report.motions import motion_numbers
from probmotion.report.page import write_report

WALK = make_gait("walk", frames=8)
SEEN = 3
"""Frames with keypoints."""


class Named:
    name = "made"


class Filmed(Comparison):
    """One problem with a perspective camera; three samplers drew near the truth, one failed."""

    def __init__(self, folder: Path) -> None:
        noise = np.random.default_rng(0).normal(size=(1, 2, *WALK.positions.shape))
        prior = GaussianMixtureMotion(
            skeleton=WALK.skeleton, fps=2.0, means=WALK.positions[None], factors=0.02 * noise,
            weights=np.ones(1), noise=0.01, azimuths=1, styles=("walk",),
        )  # fmt: skip
        camera = Cameras.around(np.array([0.7]), np.array([0.3]), perspective=True)
        hidden = np.zeros(WALK.positions.shape[:2], dtype=bool)
        hidden[SEEN:] = True
        seen = Keypoints2D(camera.project(WALK.positions), camera, 0.02, 1.0 - hidden[None])
        self.problem = Problem("filmed", "a walk", MotionPosterior(prior, seen), WALK.positions)
        self.folder = folder
        samplers: dict[str, dict[str, str]] = {name: {} for name in ("b", "c", "a", "none")}
        self.plan = Plan({"filmed": "a walk"}, samplers, draws=4, chains=1, seeds=1)
        self.results = [
            CellResult("filmed", name, 0, "", {"swd_ratio": swd, "seconds": 1.0})
            for name, swd in (("b", 30.0), ("c", 4.0), ("a", 200.0))
        ]
        failed = Failure("memory", "there was too little memory", unsupported=False)
        self.results.append(CellResult("filmed", "none", 0, "", {}, failed))
        store_problem(self.problem, folder / "problems" / "filmed")

    def draws(self, problem: str, sampler: str, seed: int = 0) -> MotionDraws:
        rng = seeds.generator(seed, sampler)
        drawn = WALK.positions + 0.05 * rng.normal(size=(1, 4, *WALK.positions.shape))
        return MotionDraws.of(self.problem.posterior, Named(), drawn, seed=0, seconds=1.0)


# Where time is virtual, chromium draws no frames and sees no place: clocks stand for them. The
# test of a live page has it draw.
WATCH = """
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now() - 30), 16);
window.cancelAnimationFrame = clearTimeout;
window.IntersectionObserver = class {
  constructor(tell) { this.tell = tell; }
  observe() { setTimeout(() => this.tell([{ isIntersecting: true }]), 0); }
};
const errors = [];
window.addEventListener("error", (event) => errors.push(event.message));
window.addEventListener("unhandledrejection", (event) => errors.push(String(event.reason)));
document.addEventListener("securitypolicyviolation", (event) => errors.push(event.blockedURI));
console.error = console.warn = (...words) => errors.push(words.join(" "));
const pause = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));
const watch = async () => {
  const seen = { globals: Object.keys(window).filter((name) => !NAMES.has(name)) };
  const find = (selector) => document.querySelector(`.player ${selector}`);
  const [play, camera, truth] = ["play", "camera", "truth"].map((x) => find(`[data-does=${x}]`));
  const [range, cards] = [find("input[type=range]"), find(".cards")];
  const canvases = [...document.querySelectorAll("canvas")];
  const look = () => canvases.map((canvas) => canvas.toDataURL());
  const same = (one, other) => one.map((picture, n) => picture === other[n]);
  const press = (element, key) =>
    element.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
  await pause(0.1);
  seen.starts = play.textContent;
  const begun = look();
  await pause(2.2);
  seen.same = same(look(), begun);
  seen.frame = range.value;
  seen.told = range.getAttribute("aria-valuetext");
  press(cards, " ");
  seen.stopped = play.textContent;
  const still = look();
  await pause(1.2);
  seen.still = same(look(), still);
  seen.frames = ["End", ".", ",", "Home", "."].map((key) => (press(cards, key), range.value));
  press(range, "Home");
  seen.sliderKeepsItsKeys = range.value;
  press(cards, "Home");

  const front = look();
  seen.turns = {};
  const back = { ArrowLeft: "ArrowRight", ArrowUp: "ArrowDown" };
  for (const key of Object.keys(back)) {
    press(cards, key);
    const turned = same(look(), front);
    press(cards, back[key]);
    seen.turns[key] = [turned, same(look(), front)];
  }
  canvases[0].setPointerCapture = () => {};
  for (const [type, x] of [["pointerdown", 0], ["pointermove", 60], ["pointerup", 60]]) {
    canvases[0].dispatchEvent(new PointerEvent(type, { clientX: x, pointerId: 1, bubbles: true }));
  }
  seen.dragged = same(look(), front);
  truth.click();
  const bare = look();
  seen.truth = truth.checked;
  truth.click();
  seen.withTruth = same(look(), bare);

  press(cards, "c");
  seen.pressed = camera.getAttribute("aria-pressed");
  const canvas = canvases[0];
  const place = canvas.clientWidth / DATA.columns;
  const scale = Math.min(place / DATA.across, canvas.clientHeight / DATA.up);
  // A colour that no bones make where they cross.
  document.documentElement.style.setProperty("--seen", "#ff00ff");
  window.dispatchEvent(new Event("resize"));
  const ringed = (places) => places.map(([x, y]) => {
    const left = Math.round(place / 2 + scale * x) - 3;
    const top = Math.round(canvas.clientHeight / 2 + scale * y) - 3;
    const { data } = canvas.getContext("2d").getImageData(left, top, 7, 7);
    return [...Array(49).keys()].some((n) => data[4 * n + 3] > 100 && data[4 * n] > 170
      && data[4 * n + 1] < 90 && data[4 * n + 2] > 170);
  });
  seen.ringed = PLACES.map((places, frame) => {
    range.value = frame;
    range.dispatchEvent(new Event("input", { bubbles: true }));
    return ringed(places);
  });
  press(cards, "ArrowLeft");
  seen.left = camera.getAttribute("aria-pressed");
  play.click();
  seen.again = play.textContent;

  const table = document.querySelector("table");
  const heads = [...table.tHead.rows[0].cells];
  const names = () => [...table.tBodies[0].rows].map((row) => row.cells[0].dataset.value);
  const sort = (n) => {
    const button = heads[n].querySelector("button");
    button.focus();
    button.click();
    return [names(), heads.map((head) => head.getAttribute("aria-sort")),
      document.activeElement === button && button.tabIndex === 0];
  };
  seen.sorted = [names(), sort(2), sort(2), sort(0)];
  const wide = document.documentElement;
  seen.fits = wide.scrollWidth <= wide.clientWidth;
  seen.errors = errors;
  const report = document.createElement("pre");
  report.textContent = "seen:" + JSON.stringify(seen) + ":seen";
  document.body.append(report);
};
const NAMES = new Set(Object.keys(window));
"""


def places(camera: Cameras, height: float) -> list[list[list[float]]]:
    """Return where a camera sees each joint of the truth, metres from the body's middle."""
    middle = WALK.positions[:, list(WALK.skeleton.roots)]
    middle[..., 1] = height
    found = camera.project(WALK.positions)[0] - camera.project(middle)[0]
    metres = camera.depth(middle)[0] / camera.focal[0]
    return (found * metres[..., None]).tolist()


def watched(folder: Path, *words: str) -> dict:
    """Write the page, let a browser play it, and return what was seen."""
    browser = browser_command()
    comparison = Filmed(folder)
    path = write_report(comparison, folder / "report.html")
    data = motion_numbers(shown_problems(comparison)["filmed"])
    known = {name: data[name] for name in ("columns", "across", "up")}
    seen = places(StoredProblem.of(comparison.problem).camera, data["middle"])
    script = f"const DATA = {json.dumps(known)}; const PLACES = {json.dumps(seen)};{WATCH}"
    page = path.read_text(encoding="utf-8")
    page = page.replace("<body>", f"<body><script>{script}</script>", 1)
    page = page.replace("</body>", "<script>watch();</script></body>", 1)
    path.write_text(page, encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"]
    flags += ["--disable-background-networking", f"--user-data-dir={folder}/profile"]
    flags += ["--virtual-time-budget=9000", "--force-device-scale-factor=1", "--dump-dom", *words]
    done = subprocess.run(
        [browser, *flags, path.as_uri()], capture_output=True, text=True, timeout=120, check=False
    )
    found = re.search(r"<pre>seen:(.*):seen</pre>", done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    return json.loads(html.unescape(found.group(1)))


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> dict:
    return watched(tmp_path_factory.mktemp("report"), "--window-size=500,800")


def test_there_is_no_error_and_nothing_global(seen):
    assert seen["errors"] == []
    assert seen["globals"] == []
    assert seen["fits"]


def test_all_skeletons_play_by_one_clock_and_stop(seen):
    assert (seen["starts"], seen["stopped"], seen["again"]) == ("Stop", "Play", "Stop")
    # 2.3 seconds at two frames a second, less what a busy machine keeps its clock waiting.
    assert 1 <= int(seen["frame"]) <= 4
    assert seen["told"] == f"frame {int(seen['frame']) + 1} of 8"
    assert seen["same"] == 3 * [False]
    assert seen["still"] == 3 * [True]


def test_keys_step_and_turn(seen):
    assert seen["frames"] == ["7", "7", "6", "0", "1"]
    # The browser itself moves a slider that a key is hit on.
    assert seen["sliderKeepsItsKeys"] == "1"
    for turned, back in seen["turns"].values():
        assert turned == 3 * [False]
        assert back == 3 * [True]
    assert seen["dragged"] == 3 * [False]
    assert not seen["truth"]
    assert seen["withTruth"] == 3 * [False]


def test_the_cameras_view_has_the_keypoints_where_the_camera_saw_them(seen):
    assert (seen["pressed"], seen["left"]) == ("true", "false")
    for frame, ringed in enumerate(seen["ringed"]):
        assert ringed == len(ringed) * [frame < SEEN]


def test_tables_are_sorted_by_a_press_on_a_head(seen):
    begun, up, down, named = seen["sorted"]
    assert begun == ["b", "c", "a", "none"]
    assert up == [["c", "b", "a", "none"], [None, None, "ascending"], True]
    # What failed has no place among numbers, and stays last.
    assert down == [["a", "b", "c", "none"], [None, None, "descending"], True]
    assert named == [["a", "b", "c", "none"], ["ascending", None, None], True]


def test_nothing_moves_by_itself_where_that_is_not_wanted(tmp_path):
    seen = watched(tmp_path, "--force-prefers-reduced-motion")
    assert seen["starts"] == "Play"
    assert seen["same"] == 3 * [True]
    assert seen["stopped"] == "Stop"
    assert seen["errors"] == []

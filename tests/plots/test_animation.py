"""Skeletons that play: what the page holds, and what a real browser makes of it."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from probmotion import Cameras, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.plots.animation import play_skeletons, playing_figure
from probmotion.plots.colours import INK, LEFT, RIGHT

WALK = make_gait("walk", frames=20)
ROW = WALK.positions[None]
BODY = Skeleton(["pelvis", "neck", "left_knee", "right_knee"], [-1, 0, 0, 0])
# Seen apart from everywhere that the tests look from.
POSES = np.array(
    [
        [[0, 0, 0], [0.0, 0.5, 0.0], [0.4, -0.5, 0.0], [-0.4, -0.5, 0.0]],
        [[0, 0, 0], [0.0, 0.5, 0.1], [0.1, -0.5, 0.5], [-0.1, -0.6, -0.5]],
        [[0, 0, 0], [0.1, 0.5, 0.0], [0.4, 0.2, 0.0], [-0.4, 0.1, 0.1]],
        [[0, 0, 0], [0.0, 0.4, 0.2], [0.3, 0.3, 0.3], [-0.4, -0.1, 0.0]],
    ]
)


def data_of(page: str) -> dict:
    """Return what a page's script is given."""
    (found,) = re.findall(r"parentElement, (\{.*\})\);</script>", page)
    return json.loads(found)


def test_places_are_whole_millimetres_about_the_roots():
    held = data_of(play_skeletons({"walk": ROW}, WALK.skeleton, fps=30).html)
    assert (held["frames"], held["joints"], held["fps"]) == (20, WALK.skeleton.n_joints, 30)
    numbers = held["rows"][0]["motions"][0]
    assert all(isinstance(number, int) for number in numbers)
    root = WALK.skeleton.roots[0]
    wanted = WALK.positions - WALK.positions[:, [root]] * np.array([1, 0, 1])
    found = np.array(numbers).reshape(WALK.positions.shape) / 1000
    np.testing.assert_allclose(found, wanted, atol=0.0005 + 1e-9)
    # Turned and far away, it is in the same place: the middle.
    assert np.ptp(found[:, root, [0, 2]]) == 0


def test_bones_have_the_side_of_their_joint():
    held = data_of(playing_figure({"body": POSES[None]}, BODY, fps=1))
    assert held["bones"] == [[1, 0, "middle"], [2, 0, "left"], [3, 0, "right"]]
    assert held["colours"] == {"left": LEFT, "right": RIGHT, "middle": INK}


def test_the_first_row_sets_the_scale_and_draws_are_cut():
    many = np.repeat(ROW, 6, axis=0)
    alone = data_of(playing_figure({"walk": many}, WALK.skeleton, fps=30))
    two = data_of(playing_figure({"walk": many, "giant": 5 * many}, WALK.skeleton, fps=30))
    assert (alone["scale"], alone["place"]) == (two["scale"], two["place"])
    assert [len(row["motions"]) for row in two["rows"]] == [4, 4]
    assert two["height"] == 2 * alone["height"]
    one = data_of(playing_figure({"walk": many}, WALK.skeleton, fps=30, draws=1))
    assert one["width"] - one["margin"] == (alone["width"] - alone["margin"]) / 4


def test_a_page_of_its_own_and_a_frame_for_notebooks(tmp_path):
    shown = play_skeletons({"walk": ROW}, WALK.skeleton, tmp_path / "walk.html", fps=30)
    assert (tmp_path / "walk.html").read_text(encoding="utf-8") == shown.html
    # Nothing is fetched from elsewhere, and two figures have no name in common.
    assert not re.search(r"https?:|src=|href=|@import| id=", shown.html)
    frame = shown._repr_html_()
    assert html.unescape(re.search(r'srcdoc="([^"]*)"', frame).group(1)) == shown.html
    assert f'width="{shown.width}" height="{shown.height}"' in frame


def test_words_are_words_and_never_markup():
    label = '</script><b onclick="x">&'
    page = play_skeletons({label: ROW}, WALK.skeleton, fps=30, title=label).html
    assert page.count("</script>") == page.count("<script>") == 1
    assert "<b onclick" not in page
    assert data_of(page)["rows"][0]["label"] == [label]


@pytest.mark.parametrize(
    ("rows", "options", "said"),
    [
        ({}, {}, "rows is empty"),
        ({"a": np.zeros((2, 5, 3, 3))}, {}, r"rows\['a'\] has shape \(2, 5, 3, 3\)"),
        ({"a": np.full((1, 2, 17, 3), np.nan)}, {}, r"rows\['a'\] has 102 values that are NaN"),
        ({"a": np.zeros((0, 5, 17, 3))}, {}, "expected at least one motion of at least one frame"),
        ({"a": ROW, "b": ROW[:, :9]}, {}, r"rows\['b'\] has shape .*, expected \(n, 20, 17, 3\)"),
        ({"a": ROW}, {"fps": 0}, "fps is 0, expected"),
        ({"a": ROW}, {"draws": 0}, "draws is 0, expected"),
        ({"a": ROW}, {"path": "walk.png"}, r"ends in \.html"),
    ],
)
def test_what_cannot_be_played_is_refused(rows, options, said):
    with pytest.raises(ValueError, match=said):
        play_skeletons(rows, WALK.skeleton, **{"fps": 30, **options})


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(OSError, match="cannot write"):
        play_skeletons({"a": ROW}, WALK.skeleton, tmp_path / "missing" / "walk.html", fps=30)
    assert list(tmp_path.iterdir()) == []


# Where time is virtual, chromium draws no frames: a clock stands for them, whose first one is, as a
# real one may be, from before it was asked for.
WATCH = """
const told = new Set();
window.requestAnimationFrame = (draw) => setTimeout(() => {
  draw(performance.now() - 30);
  told.add(document.querySelector("input").getAttribute("aria-valuetext"));
}, 16);
const pause = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));
const errors = [];
window.addEventListener("error", (event) => errors.push(event.message));
const watch = async () => {
  const seen = {};
  const figures = [...document.querySelectorAll("figure")].map((figure) => ({
    canvas: figure.querySelector("canvas"),
    button: figure.querySelector("button"),
    range: figure.querySelector("input"),
  }));
  const [one, other] = figures;
  const look = () => one.canvas.toDataURL();
  const press = (element, key) =>
    element.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
  const colours = (places) => places.map(([x, y]) =>
    [...one.canvas.getContext("2d").getImageData(x, y, 1, 1).data]);
  const drag = (type, x, y) => one.canvas.dispatchEvent(
    new PointerEvent(type, { clientX: x, clientY: y, pointerId: 1, bubbles: true }));
  const scrub = (frame) => {
    one.range.value = frame;
    one.range.dispatchEvent(new Event("input", { bubbles: true }));
  };

  seen.globals = Object.keys(window).filter((name) => !NAMES.has(name));
  seen.starts = one.button.textContent;
  const begun = look();
  await pause(2.2);
  seen.moved = look() !== begun && one.range.value;
  seen.told = [...told].sort();
  press(one.canvas, " ");
  seen.stopped = one.button.textContent;
  press(one.button, " ");
  seen.stillStopped = one.button.textContent;
  seen.otherPlays = other.button.textContent;
  const still = look();
  await pause(2.2);
  seen.still = look() === still;

  seen.frames = [];
  for (let frame = 0; frame < 4; frame++) {
    scrub(frame);
    seen.frames.push({
      colours: colours(PLACES[frame]),
      text: one.range.getAttribute("aria-valuetext"),
    });
  }
  scrub(0);
  const front = look();
  seen.keys = {};
  const back = { ArrowLeft: "ArrowRight", ArrowUp: "ArrowDown" };
  for (const key of Object.keys(back)) {
    press(one.canvas, key);
    const turned = look() !== front;
    press(one.canvas, back[key]);
    seen.keys[key] = { turned, back: look() === front };
  }
  press(one.range, "ArrowLeft");
  seen.sliderKeepsItsArrows = look() === front;
  drag("pointermove", 50, 0);
  seen.onlyHeld = look() === front;
  one.canvas.setPointerCapture = () => {};
  drag("pointerdown", 0, 0);
  drag("pointermove", 60, 0);
  drag("pointerup", 60, 0);
  seen.dragged = colours(PLACES.dragged);
  one.button.click();
  seen.again = one.button.textContent;
  seen.errors = errors;
  const report = document.createElement("pre");
  report.textContent = "seen:" + JSON.stringify(seen) + ":seen";
  document.body.append(report);
};
const NAMES = new Set(Object.keys(window));
"""


def middles(azimuth: float, elevation: float, frame: int) -> list[list[int]]:
    """Return where the middles of BODY's bones are on its canvas, by the package's cameras."""
    held = data_of(playing_figure({"body": POSES[None]}, BODY, fps=1))
    camera = Cameras.around(np.array([azimuth]), np.array([elevation]))
    raised = POSES[frame] - np.array([0, held["middle"], 0])
    x, y = (held["scale"] * camera.project(raised[None])[0, 0]).T
    place = held["place"]
    centre = np.array([held["margin"] + place["width"] / 2, place["height"] / 2])
    points = np.stack([x, y], axis=-1) + centre
    return np.floor((points[1:] + points[:1]) / 2).astype(int).tolist()


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> dict:
    """Two figures in one page, watched in a browser while keys and pointers act on the first."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("there is no chromium to play the page in")
    folder: Path = tmp_path_factory.mktemp("browser")
    places: dict[str | int, list] = {frame: middles(0.6, 0.2, frame) for frame in range(4)}
    places["dragged"] = middles(0.6 - 0.6, 0.2, 0)
    first = playing_figure({"body": POSES[None]}, BODY, fps=1)
    second = playing_figure({"walk": ROW}, WALK.skeleton, fps=30, title="Walk")
    page = folder / "page.html"
    page.write_text(
        f"<!DOCTYPE html><html><body><script>const PLACES = {json.dumps(places)};{WATCH}</script>"
        f"{first}{second}<script>watch();</script></body></html>",
        encoding="utf-8",
    )
    words = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}/profile"]
    words += ["--virtual-time-budget=8000", "--force-device-scale-factor=1", "--dump-dom"]
    done = subprocess.run(
        [browser, *words, page.as_uri()], capture_output=True, text=True, timeout=120, check=False
    )
    found = re.search(r"<pre>seen:(.*):seen</pre>", done.stdout)
    assert found, done.stderr[-2000:]
    return json.loads(html.unescape(found.group(1)))


def test_it_plays_without_an_error_and_stops(seen):
    assert seen["errors"] == []
    assert seen["globals"] == []
    assert seen["starts"] == "Pause"
    # 2.2 seconds at one frame a second.
    assert seen["moved"] == "2"
    assert seen["told"] == [f"frame {frame} of 4" for frame in (1, 2, 3)]
    assert seen["stopped"] == "Play"
    # The browser itself presses a button that the space bar is hit on.
    assert seen["stillStopped"] == "Play"
    assert seen["still"]
    assert seen["otherPlays"] == "Pause"
    assert seen["again"] == "Pause"


def near(colours: list[list[int]]) -> list[str]:
    """Return which of the bones' colours each pixel has."""
    named = {"middle": INK, "left": LEFT, "right": RIGHT}
    found = []
    for *rgb, alpha in colours:
        apart = {
            name: np.abs(np.array(rgb) - list(bytes.fromhex(colour[1:]))).max()
            for name, colour in named.items()
        }
        best = min(apart, key=apart.get)
        found.append(best if apart[best] < 40 and alpha > 100 else "none")
    return found


def test_every_frame_is_seen_as_the_cameras_of_the_package_see_it(seen):
    for frame, shown in enumerate(seen["frames"]):
        assert near(shown["colours"]) == ["middle", "left", "right"]
        assert shown["text"] == f"frame {frame + 1} of 4"


def test_keys_and_pointers_turn_it(seen):
    for turned in seen["keys"].values():
        assert turned == {"turned": True, "back": True}
    assert seen["sliderKeepsItsArrows"]
    assert seen["onlyHeld"]
    # Dragging to the right by 60 pixels goes around by .6 to the left: to the front.
    assert near(seen["dragged"]) == ["middle", "left", "right"]

"""Animated skeletons: contents of the page, and its pixels in a browser."""

from __future__ import annotations

import base64
import html
import json
import re

import numpy as np
import pytest
from live_browser import LiveBrowser

from probmotion import Cameras, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.plots.animation import animate_skeletons
from probmotion.plots.style import LEFT, RIGHT

WALK = make_gait("walk", frames=20)
ROW = WALK.positions[None]
BODY = Skeleton(["pelvis", "neck", "left_knee", "right_knee"], [-1, 0, 0, 0])
# Bones that do not overlap in the views of the tests.
POSES = np.array(
    [
        [[0, 0, 0], [0.0, 0.5, 0.0], [0.4, -0.5, 0.0], [-0.4, -0.5, 0.0]],
        [[0, 0, 0], [0.0, 0.5, 0.1], [0.1, -0.5, 0.5], [-0.1, -0.6, -0.5]],
        [[0, 0, 0], [0.1, 0.5, 0.0], [0.4, 0.2, 0.0], [-0.4, 0.1, 0.1]],
        [[0, 0, 0], [0.0, 0.4, 0.2], [0.3, 0.3, 0.3], [-0.4, -0.1, 0.0]],
    ]
)


def data_of(rows, skeleton=WALK.skeleton, **options):
    """Return the data in a page."""
    page = animate_skeletons(rows, skeleton, **{"fps": 30, **options}).html
    (data,) = re.findall(r'json">(.*?)</script>', page)
    return json.loads(data)


def test_motions_are_millimetres_with_the_root_in_the_middle():
    turned = WALK.turned(1.0).positions + np.array([3.0, 0.0, -5.0])
    data = data_of({"walk": turned[None]})
    assert (data["frames"], data["joints"], data["fps"]) == (20, WALK.skeleton.n_joints, 30)
    motion = data["rows"][0][0]
    numbers = np.frombuffer(base64.b64decode(motion["numbers"]), "<i2")
    positions = motion["unit"] / 1000 * numbers.reshape(turned.shape)
    root = turned[:, [WALK.skeleton.roots[0]]] * np.array([1, 0, 1])
    np.testing.assert_allclose(positions, turned - root, atol=0.0005 + 1e-9)


def test_bones_have_sides_and_the_first_row_sets_the_scale():
    assert data_of({"body": POSES[None]}, BODY)["bones"] == [
        [1, 0, "ink"], [2, 0, "left"], [3, 0, "right"]
    ]  # fmt: skip
    many = np.repeat(ROW, 6, axis=0)
    alone, two = data_of({"walk": many}), data_of({"walk": many, "giant": 5 * many})
    assert (alone["across"], alone["up"]) == (two["across"], two["up"])
    assert [len(row) for row in two["rows"]] == [4, 4]


def test_the_page_is_self_contained_escaped_and_framed_in_notebooks(tmp_path):
    label = '</script><b onclick="x">&'
    shown = animate_skeletons({label: ROW}, WALK.skeleton, tmp_path / "a.html", fps=30, title=label)
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == shown.html
    assert not re.search(r"https?:|src=|href=|@import| id=", shown.html)
    assert shown.html.count("</script>") == 2
    assert "<b onclick" not in shown.html
    with pytest.raises(OSError, match="cannot write"):
        animate_skeletons({"a": ROW}, WALK.skeleton, tmp_path / "missing" / "walk.html", fps=30)
    frame = shown._repr_html_()
    assert html.unescape(re.search(r'srcdoc="([^"]*)"', frame)[1]) == shown.html
    assert f'width="{shown.width}" height="{shown.height}"' in frame


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        ({}, {}, "rows must contain at least one label with motions, got none"),
        ({"a": np.zeros((2, 5, 3, 3))}, {}, r"rows\['a'\] must have shape .*, got \(2, 5, 3, 3\)"),
        ({"a": np.full((1, 2, 17, 3), np.nan)}, {}, r"rows\['a'\] must be finite, got 102 values"),
        ({"a": np.zeros((0, 5, 17, 3))}, {}, r"rows\['a'\] must contain at least one motion"),
        ({"a": ROW, "b": ROW[:, :9]}, {}, r"rows must have motions of equal length, got \[20, 9\]"),
        ({"a": ROW}, {"fps": 0}, "fps must be a finite number above 0, got 0"),
        ({"a": ROW}, {"draws": 0}, "draws must be an integer of at least 1, got 0"),
        ({"a": ROW}, {"path": "walk.png"}, r"path must end in \.html"),
    ],
)
def test_invalid_arguments_raise(rows, options, message):
    with pytest.raises(ValueError, match=message):
        animate_skeletons(rows, WALK.skeleton, **{"fps": 30, **options})


def sides(browser, data, azimuth, frame):
    """Return the colour at the middle of each bone as the cameras of the package project it."""
    canvas = "document.querySelector('canvas')"
    width, height = browser.value(f"[{canvas}.clientWidth, {canvas}.clientHeight]")
    scale = min(width / data["columns"] / data["across"], height / data["up"])
    camera = Cameras.around(np.array([azimuth]), np.array([0.2]))
    raised = POSES[frame] - np.array([0, data["middle"], 0])
    points = scale * camera.project(raised[None])[0, 0]
    points += [width / data["columns"] / 2, height / 2]
    middles = np.floor((points[1:] + points[:1]) / 2).astype(int)
    colours = browser.value(
        f"{json.dumps(middles.tolist())}.map(([x, y]) => "
        f"[...{canvas}.getContext('2d').getImageData(x, y, 1, 1).data])"
    )
    palette = {"middle": "#222222", "left": LEFT, "right": RIGHT}
    return [
        side
        for *rgb, alpha in colours
        for side, colour in palette.items()
        if alpha > 100 and np.abs(np.array(rgb) - list(bytes.fromhex(colour[1:]))).max() < 40
    ]


def test_a_browser_draws_every_frame_as_the_cameras_of_the_package(tmp_path):
    path = tmp_path / "body.html"
    animate_skeletons({"body": POSES[None]}, BODY, path, fps=1)
    data = data_of({"body": POSES[None]}, BODY, fps=1)
    with LiveBrowser(path, tmp_path / "profile") as browser:
        browser.value("document.querySelector('.cards').focus()")
        browser.press("Home", 36)
        for frame in range(4):
            if frame:
                browser.press(".", 190)
            assert sides(browser, data, 0.6, frame) == ["middle", "left", "right"]
            output = browser.value("document.querySelector('output').textContent")
            assert output == f"frame {frame + 1} of 4"
        browser.press("Home", 36)
        # Dragging by 60 pixels to the right turns by 0.6 to the left.
        x, y = browser.position("canvas")
        browser.mouse(("Pressed", x, y), ("Moved", x + 60, y), ("Released", x + 60, y))
        assert sides(browser, data, 0.0, 0) == ["middle", "left", "right"]
        assert [error for error in browser.errors() if "Canvas2D" not in error] == []

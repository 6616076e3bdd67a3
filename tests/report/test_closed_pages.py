"""Pages in a real browser: hostile names stay text, and nothing reaches the network."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from live_browser import LiveBrowser
from made_reports import MARKUP, WALK, MadeComparison, filmed_problem

from probmotion import Cameras, Motion, Skeleton
from probmotion.lifting.checks import Check
from probmotion.lifting.page import lift_page
from probmotion.lifting.pair_page import pair_page
from probmotion.plots.animation import animate_skeletons
from probmotion.report.page import write_report
from tests.models.images.bodies import small_quadruped

HOSTILE = "<img src=x onerror=document.title=1>"
NAME = HOSTILE + MARKUP
CHECKS = [Check(NAME, 2.0, 1.0, NAME)]
PERSON = Skeleton.preset("person14")
POSITIONS = WALK.retarget(PERSON).positions
JOINTS = Skeleton([joint + NAME for joint in PERSON.joint_names], PERSON.parents)
MOTION = Motion(POSITIONS, JOINTS, 30.0, name=NAME)
DRAWS = POSITIONS + 0.02 * np.random.default_rng(0).normal(size=(4, *POSITIONS.shape))


def write_animation(path):
    motions = {NAME: WALK.positions[None]}
    animate_skeletons(motions, WALK.skeleton, path, fps=30, title=NAME)


def write_comparison(path):
    samplers = {"good": 1.0, HOSTILE: 4.0}
    write_report(MadeComparison(path.parent, [filmed_problem(3)], samplers), path)


def write_lift(path):
    """Users name the video, its cameras and, through a prior, the joints."""
    cameras = Cameras.ring(2, elevation=0.2)
    shown = [cameras, [NAME, NAME], cameras.project(POSITIONS)]
    path.write_text(lift_page(MOTION, DRAWS, *shown, CHECKS, [NAME]), encoding="utf-8")


def write_pairs(path):
    """Users name the videos and the folder, which is part of the command."""
    shown = [np.full_like(POSITIONS, 0.1), DRAWS, POSITIONS[..., :2], np.ones(len(POSITIONS))]
    path.write_text(pair_page(MOTION, *shown, [NAME], path.parent / HOSTILE), encoding="utf-8")


def write_reconstruction(path):
    """Users name the category."""
    category = replace(small_quadruped(), name=NAME)
    from probmotion.models.images.observation import ImageObservation
    from probmotion.models.images.surface_prior import SurfacePrior
    from probmotion.reconstruction.page import reconstruction_page

    prior = SurfacePrior(category, np.array([0.15]))
    theta, mask = np.full(prior.dim, 0.1), np.eye(32)[None]
    observation = ImageObservation(mask, None, None, prior.tangent, np.eye(3)[None])
    page = reconstruction_page(observation, prior, theta, {NAME: theta}, CHECKS, [NAME])
    path.write_text(page, encoding="utf-8")


@pytest.fixture
def server():
    """Server that counts requests in ``server.requests``."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.server.requests.append(self.path)
            self.send_response(204)
            self.send_header("Access-Control-Allow-Origin", "*")
            self.end_headers()

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as running:
        running.requests = []
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


LOADS = """(async (url) => {
  const load = (tag, name, parent) => new Promise((done) => {
    const element = Object.assign(document.createElement(tag), { onload: done, onerror: done });
    if (tag === "link") element.rel = "stylesheet";
    element[name] = url + tag;
    parent.append(element);
    setTimeout(done, 1000);
  });
  await Promise.all([
    load("img", "src", document.body), load("script", "src", document.body),
    load("link", "href", document.head), load("iframe", "src", document.body),
    fetch(url + "fetch").catch(() => 0),
  ]);
})(%s)"""


@pytest.mark.parametrize(
    "write",
    [write_animation, write_comparison, write_lift, write_pairs, write_reconstruction, None],
)
def test_names_stay_text_and_nothing_is_loaded(write, tmp_path, server):
    page = tmp_path / "page.html"
    if write is None:  # without a policy, the same page does load
        page.write_text("<!DOCTYPE html><title>open</title>")
    else:
        write(page)
    with LiveBrowser(page, tmp_path / "profile") as browser:
        browser.value(LOADS % json.dumps(f"http://127.0.0.1:{server.server_port}/"))
        if write is None:
            assert {"/img", "/script", "/link", "/fetch"} <= set(server.requests)
            return
        assert server.requests == []
        assert browser.value("document.title") != "1"
        assert browser.value("document.querySelectorAll('img[src=x], b, [onclick]').length") == 0
        assert browser.value("document.body.textContent").count("onerror=document.title") > 0
        assert any("Content Security Policy" in error for error in browser.errors())

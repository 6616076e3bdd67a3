"""Pages in a real browser: hostile names stay text, and nothing reaches the network."""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from live_browser import LiveBrowser
from made_reports import MARKUP, WALK, MadeComparison, filmed_problem

from probmotion.plots.animation import animate_skeletons
from probmotion.report.page import write_report

HOSTILE = "<img src=x onerror=document.title=1>"


def write_animation(path):
    motions = {HOSTILE + MARKUP: WALK.positions[None]}
    animate_skeletons(motions, WALK.skeleton, path, fps=30, title=HOSTILE + MARKUP)


def write_comparison(path):
    samplers = {"good": 1.0, HOSTILE: 4.0}
    write_report(MadeComparison(path.parent, [filmed_problem(3)], samplers), path)


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


@pytest.mark.parametrize("write", [write_animation, write_comparison, None])
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

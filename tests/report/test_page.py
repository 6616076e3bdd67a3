"""The report: complete, escaped, self-contained and of limited size."""

from __future__ import annotations

import base64
import html
import io
import json
import re
from dataclasses import replace
from datetime import date
from html.parser import HTMLParser

import numpy as np
import pytest
from made_reports import (
    MARKUP,
    WALK,
    MadeComparison,
    filmed_problem,
    generation_problem,
    joints_problem,
)
from PIL import Image

from probmotion.calibration import calibrate
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.stored_problems import StoredProblem, read_stored, store_problem
from probmotion.comparison.results.table import ComparisonTable
from probmotion.plots.motion_data import Shown, motion_numbers
from probmotion.posteriors.sampling import sampler_names
from probmotion.report.animations import (
    BUDGET,
    compared_draws,
    featured_problem,
    shown_problems,
)
from probmotion.report.page import write_report
from probmotion.report.tables import sampler_name
from probmotion.samplers import ExactSampler, ScoreDistillation

SAMPLERS = {"good": 1.25, "b<i>ad": 5.5, "none": None}


class Tags(HTMLParser):
    """Parser that checks nesting and collects tags, ids, links and table rows."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.kinds: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.kinds.append(tag)
        for name, value in attrs:
            assert not name.startswith("on")
            self.ids += [value] * (name == "id")
            self.links += [value] * (name == "href")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in ("meta", "input", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, words):
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += words


def rows_of(page: str) -> list[list[str]]:
    return [[entry.strip() for entry in row] for row in Tags(page).rows]


def write(comparison, folder, calibration=None) -> str:
    return write_report(comparison, folder / "report.html", calibration).read_text("utf-8")


def decode(motion: dict, joints: int) -> np.ndarray:
    """Return an encoded motion, (L, J, 3), metres."""
    numbers = np.frombuffer(base64.b64decode(motion["numbers"]), "<i2")
    return motion["unit"] / 1000 * numbers.reshape(-1, joints, 3)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> MadeComparison:
    problems = [filmed_problem(3), joints_problem(), generation_problem()]
    return MadeComparison(tmp_path_factory.mktemp("made"), problems, SAMPLERS, n_seeds=2)


@pytest.fixture(scope="module")
def page(made) -> str:
    return write(made, made.folder)


def test_page_is_well_formed_self_contained_and_escaped(page):
    tags = Tags(page)
    assert len(tags.ids) == len(set(tags.ids))
    assert {link.removeprefix("#") for link in tags.links} <= set(tags.ids)
    assert not re.search(r"https?:|src=\"(?!data:)|@import|url\(", page)
    assert "default-src 'none'" in page
    assert len(page) < 500_000
    # The data of three problems and of the first screen, and the script of the page.
    assert tags.kinds.count("script") == 5
    assert not {"b", "i", "u"} & set(tags.kinds)
    assert html.escape(MARKUP) in page


def test_every_run_is_in_the_tables(page, made):
    rows = rows_of(page)
    swd = [row for row in rows if row[0] == "good" and row[-1].startswith("1.75 ± 0.71")]
    assert len(swd) == len(made.plan.problems)
    # One seed of two is a single number.
    some = [row for row in rows if row[0] == "b<i>ad (1 of 2 seeds; crashed)"]
    assert len(some) == 3 * len(made.plan.problems)
    assert "5.50" in some[0][2]
    # A sampler without draws has a single cell with the reason, in a row of each problem's tables.
    assert [row for row in rows if row[0] == "none"][1:] == 9 * [["none", "obs<u>erved"]]
    assert ["sampler", "odd_one"] in rows


def test_verdicts_are_words_with_symbols_which_open_their_numbers(tmp_path):
    samplers = {"good": 1.0, "b<i>ad": 5.5, "unsure": 1.3, "none": None}
    made = MadeComparison(tmp_path, [joints_problem(), generation_problem()], samplers)
    made.judge("generation", good="right", unsure="undecided", **{"b<i>ad": "overconfident"})
    page = write(made, tmp_path)
    rows = rows_of(page)
    assert rows[0] == ["sampler", "joints", "generation"]
    words = {row[0]: row[1:] for row in rows[1:5]}
    assert words == {
        "good": ["–no verdict", "●right"],
        "b<i>ad": ["–no verdict", "▲overconfident ×1.3 and biased by 2 sd"],
        "unsure": ["–no verdict", "○undecided at 9 draws"],
        "none": 2 * ["–no draws (obs<u>erved): it cannot " + MARKUP],
    }
    opened = re.findall(r'popovertarget="([^"]*)"', page)
    assert len(opened) == 3
    for key in opened:
        (numbers,) = re.findall(rf'<div popover id="{key}".*?</div>', page, re.DOTALL)
        assert '<th scope="row">variance</th><td>0.5</td><td>0.8–1.25</td>' in numbers
    # Colour is not the only sign, and a pointer over the word shows the numbers too.
    assert page.count("variance 0.5 (0.8–1.25): outside") == 3


def test_first_screen_names_command_date_machine_and_budget(tmp_path):
    made = MadeComparison(tmp_path, [generation_problem()], SAMPLERS)
    made.plan = replace(
        made.plan, date="2026-11-24", machine="2 cores", budget="6 seconds per run",
        versions={"probmotion": "0.2", "torch": "2.9", "scipy": "1.0"},
        command=f"probmotion compare '{MARKUP}'",
    )  # fmt: skip
    page = write(made, tmp_path)
    (facts,) = re.findall(r'<ul class="facts">(.*?)</ul>', page, re.DOTALL)
    texts = [html.unescape(text) for text in re.findall(r"<li>(.*?)</li>", facts)]
    assert texts == [
        "2026-11-24", "2 cores", "8 draws on 2 chains", "6 seconds per run", "seed 0",
        "probmotion 0.2, torch 2.9",
    ]  # fmt: skip
    (command,) = re.findall(r"<code[^>]*>(.*?)</code>", facts)
    assert html.unescape(command) == made.plan.command
    made.plan = replace(made.plan, command="")
    assert 'data-does="copy"' not in write(made, tmp_path)


@pytest.mark.parametrize(
    ("argv", "command"),
    [
        (["/usr/bin/probmotion", "compare", "a b", "--seconds", "3"],
         "probmotion compare 'a b' --seconds 3"),
        (["mine.py", "compare"], ""),
    ],
)  # fmt: skip
def test_the_command_of_a_comparison_is_stored_with_it(argv, command, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", argv)
    problems, samplers = {"generation": generation_problem()}, {"exact": ExactSampler()}
    Plan.of(problems, samplers, draws=8, chains=2, seeds=1).save(tmp_path)
    monkeypatch.setattr("sys.argv", ["probmotion", "report", "folder"])
    assert Plan.load(tmp_path).command == command
    assert Plan.load(tmp_path).date == date.today().isoformat()


def test_comparison_shows_truth_recommended_and_wrong_samplers(tmp_path):
    samplers = {"exact": 1.0, "bad": 5.0, "fast": 1.0, "slow": 2.0, "worse": 9.0, "none": None}
    problems = [generation_problem(), joints_problem(), filmed_problem(3)]
    made = MadeComparison(tmp_path, problems, samplers)
    made.judge("joints", exact="right", fast="right", slow="right", bad="biased", worse="biased")
    # The first problem with observations.
    assert featured_problem(made) == "joints"
    page = compared_draws(made, "joints", made.verdicts()["joints"])
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page)
    assert captions == [
        "truth", "fast: right", *(f"{name}: biased by 2 sd" for name in ("bad", "worse"))
    ]  # fmt: skip
    data = json.loads(re.findall(r'json">(.*?)</script>', page)[0])
    assert [len(row) for row in data["rows"]] == [1, 4, 4, 4]
    # Joints are coloured by their standard deviation over all draws.
    drawn = made.draws("joints", "bad").flat()
    sd = np.frombuffer(base64.b64decode(data["sds"][2]), "<i2").reshape(drawn.shape[1:3])
    expected = 1000 * np.sqrt(drawn.var(axis=0, ddof=1).sum(axis=-1))
    np.testing.assert_allclose(sd, expected, atol=0.51)
    assert data["sds"][0] is None
    # Undecided samplers come before wrong ones if none is right.
    made.judge("joints", exact="undecided", fast="undecided", slow="biased", bad="biased")
    page = compared_draws(made, "joints", made.verdicts()["joints"])
    assert "fast: undecided" in page
    assert "<figcaption>exact" not in page


def test_failures_link_to_their_notes(page, made):
    for sentence in made.notes:
        assert re.search(rf'<li id="note-\d+">{re.escape(html.escape(sentence))}</li>', page)
    place = next(n for n, note in enumerate(made.notes) if note.startswith("none on joints"))
    assert f'<a href="#note-{place}" title="it cannot ' in page


def test_unfinished_runs_are_reported(tmp_path):
    made = MadeComparison(tmp_path, [generation_problem()], SAMPLERS)
    made.results = [result for result in made.results if result.sampler != "good"]
    assert ["good", "unfinished"] in rows_of(write(made, tmp_path))
    made.results = []
    assert Tags(write(made, tmp_path)).ids


@pytest.mark.parametrize("n_seeds", [1, 2])
def test_only_differences_over_several_seeds_are_highlighted(tmp_path, n_seeds):
    made = MadeComparison(tmp_path, [joints_problem()], {"good": 1.25, "bad": 5.5}, n_seeds)
    page = write(made, tmp_path)
    assert ("With one seed no sampler can be distinguished" in page) == (n_seeds == 1)
    assert ('title="best">★' in page) == (n_seeds > 1)
    # With one of two seeds finished.
    made.results = [result for result in made.results if result.seed == 0]
    assert 'title="best">★' not in write(made, tmp_path)


def shown_by_name(made, **budget):
    return dict(zip(made.plan.problems, shown_problems(made, **budget), strict=True))


def test_motions_are_encoded_in_millimetres(made):
    shown = shown_by_name(made)["joints"]
    data = motion_numbers(shown)
    path = WALK.positions[:, list(WALK.skeleton.roots)].mean(axis=1) * [1, 0, 1]
    truth = decode(data["truth"], data["joints"])
    np.testing.assert_allclose(truth, WALK.positions - path[:, None], atol=6e-4)
    assert list(shown.rows) == ["reference draws", "good", "b<i>ad"]
    drawn = made.draws("joints", "good").flat()
    second = decode(data["rows"][1][1], data["joints"])
    # Of 8 draws every second is shown.
    np.testing.assert_allclose(second, drawn[2] - path[:, None], atol=6e-4)
    dots = np.frombuffer(base64.b64decode(data["dots"]), "<f4").reshape(WALK.positions.shape)
    np.testing.assert_allclose(dots, shown.problem.joints - path[:, None], atol=1e-6)


def test_motions_beyond_16_bits_have_a_coarser_unit():
    far = np.array([[[[0.0, 0.0, 0.0], [0.0, 1.0, 70.0]]]]) + np.zeros((1, 3, 1, 1))
    body = type(WALK.skeleton)(["root", "head"], [-1, 0])
    (motion,) = motion_numbers(Shown(StoredProblem(body, 30.0), {"far": far}))["rows"][0]
    assert motion["unit"] == 3
    np.testing.assert_allclose(decode(motion, 2)[0], far[0, 0], atol=2e-3)


def test_large_grids_show_fewer_draws_then_fewer_frames(made):
    full = shown_by_name(made)
    size = 2 * sum(row.size for shown in full.values() for row in shown.rows.values())
    half = shown_by_name(made, budget=size // 2)["joints"]
    assert [len(row) for row in half.rows.values()] == [1, 2, 2]
    assert half.step == 1
    least = shown_by_name(made, budget=size // 16)["joints"]
    assert (len(least.rows["good"]), least.step) == (1, 4)
    assert motion_numbers(least)["frames"] == least.frames == 3
    assert motion_numbers(least)["fps"] == 7.5


@pytest.mark.parametrize("make", [lambda: filmed_problem(3), joints_problem, generation_problem])
def test_stored_problems_are_read_back(make, tmp_path):
    given, folder = make(), tmp_path / "stored"
    assert read_stored(folder) is None
    store_problem(given, folder, draws=3)
    stored, expected = read_stored(folder), StoredProblem.of(given, 3)
    assert (stored.skeleton, stored.fps) == (expected.skeleton, expected.fps)
    assert stored.has_observations == (given.name != "generation")
    assert given.has_reference == (given.name != "filmed")
    for name in ("truth", "reference", "keypoints", "joints"):
        value = getattr(expected, name)
        if value is None:
            assert getattr(stored, name) is None
        else:
            np.testing.assert_allclose(getattr(stored, name), value, atol=1e-6)
    if given.name == "filmed":
        observed = stored.camera.project(given.truth)[0]
        visible = np.isfinite(stored.keypoints[..., 0])
        assert visible[:3].all()
        assert not visible[3:].any()
        np.testing.assert_allclose(stored.keypoints[visible], observed[visible], atol=1e-4)
    (folder / "problem.npz").write_bytes(b"half")
    with pytest.raises(ValueError, match="is damaged"):
        read_stored(folder)


def test_invalid_paths_raise_and_write_nothing(made, tmp_path):
    with pytest.raises(ValueError, match=r"path must end in \.html"):
        write_report(made, tmp_path / "report.pdf")
    with pytest.raises(OSError, match="cannot write"):
        write_report(made, tmp_path / "missing" / "report.html")
    assert list(tmp_path.iterdir()) == []


class Calibrated:
    """Calibration with a noisy figure and an empty table."""

    ranked = True

    def table(self) -> ComparisonTable:
        return ComparisonTable([], columns=["problem", "sampler", "seed", "metric", "value"])

    def plot(self, path) -> None:
        shades = np.random.default_rng(0).integers(0, 12, (100, 2000))
        colours = np.random.default_rng(1).integers(0, 256, (12, 3))
        Image.fromarray(colours[shades].astype(np.uint8)).save(path)


def test_calibration_figure_is_in_the_page(made, tmp_path):
    page = write(made, tmp_path, Calibrated())
    assert "calibration" in Tags(page).ids
    source = re.search(r'<img class="plot calibration" src="data:image/png;base64,([^"]*)"', page)
    encoded, drawn = base64.b64decode(source[1]), tmp_path / "drawn.png"
    Calibrated().plot(drawn)
    assert len(encoded) < drawn.stat().st_size / 2
    images = [Image.open(file).convert("RGB") for file in (io.BytesIO(encoded), drawn)]
    one, other = (np.asarray(image, float) for image in images)
    assert np.abs(one - other).max() < 64


def test_a_calibration_without_ranks_has_no_figure(made, tmp_path):
    sampler = ScoreDistillation(iterations=3)
    settings = {"simulations": 10, "draws": 10, "chains": 1, "workers": 0, "progress": False}
    calibration = calibrate("gait-monocular(frames=4)", sampler, **settings)
    assert not calibration.ranked
    page = write(made, tmp_path, calibration)
    assert "No sampler has ranks" in page
    assert "sds on gait-monocular" in page
    assert 'class="plot calibration"' not in page


def test_figures_reduce_the_budget_of_the_motions(made, tmp_path, monkeypatch):
    budgets = []
    shown, none = "probmotion.report.page.shown_problems", [None] * len(made.plan.problems)
    monkeypatch.setattr(shown, lambda comparison, budget: budgets.append(budget) or none)
    page = write(made, tmp_path, Calibrated())
    figures = [base64.b64decode(text) for text in re.findall(r';base64,([^"]*)" alt', page)]
    assert len(figures) == len(made.plan.problems) + 1
    assert budgets == [BUDGET - sum(map(len, figures))]


def test_every_sampler_has_a_mark_in_tables():
    for name in sampler_names():
        assert f"</svg> {name}" in sampler_name(name)

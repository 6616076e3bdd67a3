"""The page of a comparison: what it holds, that nothing is missing, and that no word is markup."""

from __future__ import annotations

import base64
import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from probmotion import Cameras, MotionDraws, MotionPosterior, seeds
from probmotion.calibration import calibrate
from probmotion.comparison.comparison import Comparison
from probmotion.comparison.results.cell_results import CellResult
from probmotion.comparison.results.failures import Failure
from probmotion.comparison.results.stored_problems import StoredProblem, read_stored, store_problem
from probmotion.comparison.results.table import ComparisonTable
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models import GaussianMixtureMotion
from probmotion.plots.label_placement import place_labels
from probmotion.plots.ranks import draw_ranks
from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.problem import Problem
from probmotion.report.animations import BUDGET, shown_problems
from probmotion.report.motions import Shown, motion_numbers
from probmotion.report.page import write_report
from probmotion.samplers import ScoreDistillation

SCRIPT = "</script><script>alert(1)</script><b onclick='x'>&\"'"
WALK = make_gait("walk", frames=12)


def prior() -> GaussianMixtureMotion:
    """Return a prior about one walk, whose draws are near it."""
    noise = np.random.default_rng(0).normal(size=(1, 2, *WALK.positions.shape))
    return GaussianMixtureMotion(
        skeleton=WALK.skeleton, fps=30.0, means=WALK.positions[None], factors=0.02 * noise,
        weights=np.ones(1), noise=0.01, azimuths=1, styles=("walk",),
    )  # fmt: skip


def problem(kind: str) -> Problem:
    if kind == "generation":
        return Problem(kind, "no evidence", MotionPosterior(prior()))
    if kind == "joints":
        evidence: Joints3D | Keypoints2D = Joints3D.observe(WALK, 0.02, 0)
    else:
        cameras = Cameras.around(np.array([0.7]), np.array([0.3]), perspective=kind == "pinhole")
        hidden = np.zeros(WALK.positions.shape[:2], dtype=bool)
        hidden[3:] = True
        evidence = Keypoints2D.observe(WALK, cameras, 1e-6, 0, hidden=hidden)
    return Problem(kind, f"{kind} {SCRIPT}", MotionPosterior(prior(), evidence), WALK.positions)


class Named:
    name = "made"


class Made(Comparison):
    """A comparison whose numbers and draws are made up; one sampler fails everywhere, one once."""

    def __init__(self, folder: Path, problems: list[Problem], numbers: int = 2) -> None:
        self.folder = folder
        self.problems = {p.name: p for p in problems}
        self.plan = self._plan(numbers)
        self.results = [self._result(*address) for address in self.plan.cells()]
        for p in problems:
            store_problem(p, folder / "problems" / p.name, draws=2)

    def _plan(self, numbers: int):
        from probmotion.comparison.results.plan import Plan

        samplers: dict[str, dict[str, str]] = {"good": {}, "b<i>ad": {"path": SCRIPT}, "none": {}}
        told = {name: p.description for name, p in self.problems.items()}
        return Plan(told, samplers, draws=8, chains=2, seeds=numbers)

    def _result(self, name: str, sampler: str, seed: int) -> CellResult:
        failure = None
        if sampler == "none":
            failure = Failure("evid<u>ence", f"it cannot {SCRIPT}", unsupported=True)
        elif sampler == "b<i>ad" and seed == 1:
            failure = Failure("crashed", "the floor gave way", unsupported=False)
        value = 1.25 if sampler == "good" else 5.5
        metrics = {"swd_ratio": value + seed, "seconds": 3 * value, "odd_one": 7.0, "rhat": np.nan}
        return CellResult(name, sampler, seed, "", {} if failure else metrics, failure)

    def draws(self, problem: str, sampler: str, seed: int = 0) -> MotionDraws:
        posterior = self.problems[problem].posterior
        rng = seeds.generator(seed, problem, sampler)
        spread = 0.02 if sampler == "good" else 0.2
        drawn = WALK.positions + spread * rng.normal(size=(2, 4, *WALK.positions.shape))
        return MotionDraws.of(posterior, Named(), drawn, seed=seed, seconds=1.0)


class Tags(HTMLParser):
    """Follows tags: which are open, ids, and the words of rows and notes."""

    EMPTY = ("meta", "input", "img", "br")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.kinds: list[str] = []
        self.rows: list[list[str]] = []

    def handle_starttag(self, tag, attrs):
        self.kinds.append(tag)
        held = dict(attrs)
        assert not any(name.startswith("on") for name in held)
        self.ids += [held["id"]] if "id" in held else []
        self.links += [held["href"]] if "href" in held else []
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, words):
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += words


def read(page: str) -> Tags:
    tags = Tags()
    tags.feed(page)
    tags.close()
    assert tags.open == []
    return tags


def data_of(page: str) -> list[dict]:
    """Return the numbers of every problem's players."""
    return [json.loads(found) for found in re.findall(r'json">(.*?)</script>', page)]


def numbers_of(motion: dict, joints: int) -> np.ndarray:
    """Return a motion of the page, (L, J, 3), metres."""
    found = np.frombuffer(base64.b64decode(motion["numbers"]), "<i2").astype(float)
    return motion["unit"] / 1000 * found.reshape(-1, joints, 3)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    problems = [problem(kind) for kind in ("pinhole", "joints", "generation")]
    return Made(tmp_path_factory.mktemp("made"), problems)


@pytest.fixture(scope="module")
def page(made) -> str:
    path = made.report(made.folder / "report.html")
    assert path == made.folder / "report.html"
    return path.read_text(encoding="utf-8")


def test_it_is_one_page_of_whole_tags_and_different_ids(page):
    tags = read(page)
    assert len(tags.ids) == len(set(tags.ids))
    assert {link.removeprefix("#") for link in tags.links} <= set(tags.ids)
    assert not re.search(r"https?:|src=\"(?!data:)|@import|url\(", page)
    assert "default-src 'none'" in page
    assert len(page) < 400_000


def test_no_word_is_markup(page):
    tags = read(page)
    # Numbers of three problems, and the page's own script.
    assert tags.kinds.count("script") == 4
    assert not {"b", "i", "u"} & set(tags.kinds)
    assert "alert(1)" in page
    assert html.escape(SCRIPT) in page


def test_every_cell_of_the_grid_is_there(page, made):
    rows = [[cell.strip() for cell in row] for row in read(page).rows]
    swd = [row for row in rows if row[0] == "good" and row[-1].startswith("1.75 ± 0.71")]
    assert len(swd) == len(made.plan.problems)
    # One seed of two: a single number, and how many seeds it is of.
    some = [row for row in rows if row[0] == "b<i>ad (1 of 2 seeds; crashed)"]
    assert len(some) == 3 * len(made.plan.problems)
    assert "5.50" in some[0][2]
    # A sampler without draws says why in every table, and has no other cell.
    assert [row for row in rows if row[0] == "none"] == 9 * [["none", "evid<u>ence"]]
    assert ["sampler", "odd_one"] in rows
    overview = [row for row in rows if row[0] in made.plan.problems]
    assert [row[1] for row in overview] == 3 * ["swd_ratio"]
    assert all("evid<u>ence" in row[4] for row in overview)


def test_failures_lead_to_their_sentences(page, made):
    for sentence in made.notes:
        assert re.search(rf'<li id="note-\d+">{re.escape(html.escape(sentence))}</li>', page)
    place = next(n for n, note in enumerate(made.notes) if note.startswith("none on joints"))
    assert f'<a href="#note-{place}" title="it cannot ' in page
    assert page.count("<figcaption>no point: none (evid&lt;u&gt;ence)</figcaption>") == 3


def test_what_is_unfinished_is_said(made, tmp_path):
    less = Made(tmp_path, [problem("generation")])
    less.results = [result for result in less.results if result.sampler != "good"]
    rows = read(write_report(less, tmp_path / "less.html").read_text(encoding="utf-8")).rows
    assert ["good", "unfinished"] in [[cell.strip() for cell in row] for row in rows]
    assert read(page_of_nothing(less, tmp_path)).ids


def page_of_nothing(comparison: Made, folder: Path) -> str:
    comparison.results = []
    return write_report(comparison, folder / "nothing.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("numbers", [1, 2])
def test_only_what_several_seeds_tell_is_marked(tmp_path, numbers):
    told = Made(tmp_path, [problem("joints")], numbers)
    page = write_report(told, tmp_path / "report.html").read_text(encoding="utf-8")
    assert ("With one seed no sampler can be told from another" in page) == (numbers == 1)
    assert ('title="best">★' in page) == (numbers > 1)
    # Of those asked for only one has ended.
    told.results = [result for result in told.results if result.seed == 0]
    page = write_report(told, tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'title="best">★' not in page


def test_motions_are_whole_millimetres_where_they_were_drawn(made):
    shown = shown_problems(made)["joints"]
    data = motion_numbers(shown)
    path = WALK.positions[:, list(WALK.skeleton.roots)].mean(axis=1) * [1, 0, 1]
    np.testing.assert_allclose(
        numbers_of(data["truth"], data["joints"]), WALK.positions - path[:, None], atol=6e-4
    )
    assert list(shown.rows) == ["reference draws", "good", "b<i>ad"]
    drawn = made.draws("joints", "good").flat()
    found = numbers_of(data["rows"][1][1], data["joints"])
    # Draws are far apart: of 8, the second of 4 is the third.
    np.testing.assert_allclose(found, drawn[2] - path[:, None], atol=6e-4)
    dots = np.frombuffer(base64.b64decode(data["dots"]), "<f4").reshape(WALK.positions.shape)
    np.testing.assert_allclose(dots, shown.problem.joints - path[:, None], atol=1e-6)


def test_what_16_bits_do_not_hold_has_a_coarser_unit():
    far = np.array([[[[0.0, 0.0, 0.0], [0.0, 1.0, 70.0]]]]) + np.zeros((1, 3, 1, 1))
    skeleton = make_gait("walk", frames=2).skeleton
    body = type(skeleton)(["root", "head"], [-1, 0])
    (motion,) = motion_numbers(Shown(StoredProblem(body, 30.0), {"far": far}))["rows"][0]
    assert motion["unit"] == 3
    np.testing.assert_allclose(numbers_of(motion, 2)[0], far[0, 0], atol=2e-3)


def test_a_large_grid_shows_fewer_draws_then_fewer_frames(made):
    full = shown_problems(made)
    size = 2 * sum(row.size for shown in full.values() for row in shown.rows.values())
    half = shown_problems(made, budget=size // 2)["joints"]
    assert [len(row) for row in half.rows.values()] == [1, 2, 2]
    assert half.step == 1
    least = shown_problems(made, budget=size // 16)["joints"]
    assert (len(least.rows["good"]), least.step) == (1, 4)
    assert motion_numbers(least)["frames"] == least.frames == 3
    assert motion_numbers(least)["fps"] == 7.5


@pytest.mark.parametrize("kind", ["pinhole", "joints", "generation"])
def test_kept_problems_come_back(kind, tmp_path):
    given = problem(kind)
    assert read_stored(tmp_path / "there") is None
    store_problem(given, tmp_path / "there", draws=3)
    kept = read_stored(tmp_path / "there")
    wanted = StoredProblem.of(given, 3)
    assert (kept.skeleton, kept.fps) == (wanted.skeleton, wanted.fps)
    assert kept.has_observations == (kind != "generation")
    assert given.has_reference == (kind != "pinhole")
    for name in ("truth", "reference", "keypoints", "joints"):
        want = getattr(wanted, name)
        if want is None:
            assert getattr(kept, name) is None
        else:
            np.testing.assert_allclose(getattr(kept, name), want, atol=1e-6)
    if kind == "pinhole":
        seen = kept.camera.project(given.truth)[0]
        there = np.isfinite(kept.keypoints[..., 0])
        assert there[:3].all()
        assert not there[3:].any()
        np.testing.assert_allclose(kept.keypoints[there], seen[there], atol=1e-4)
    (tmp_path / "there" / "problem.npz").write_bytes(b"half")
    with pytest.raises(ValueError, match="is damaged"):
        read_stored(tmp_path / "there")


def test_labels_do_not_cover_each_other():
    marks = {name: (100.0, 100.0 + n, 112.0, 112.0 + n) for n, name in enumerate("abcdef")}
    places = place_labels(marks, dict.fromkeys(marks, (30.0, 14.0)), (0, 0, 300, 300))
    boxes = [box for box, _ in places.values()]
    for n, one in enumerate(boxes):
        for other in boxes[:n]:
            across = min(one[2], other[2]) - max(one[0], other[0])
            assert across <= 0 or min(one[3], other[3]) - max(one[1], other[1]) <= 0


def test_what_is_no_page_is_refused(made, tmp_path):
    with pytest.raises(ValueError, match=r"ends in \.html"):
        write_report(made, tmp_path / "report.pdf")
    with pytest.raises(OSError, match="cannot write"):
        write_report(made, tmp_path / "missing" / "report.html")
    assert list(tmp_path.iterdir()) == []


class Calibrated:
    """A calibration of which only a picture and a table are there, a block per sampler."""

    ranked = True

    def __init__(self, blocks: int) -> None:
        self.blocks = blocks

    def table(self) -> ComparisonTable:
        return ComparisonTable([], columns=["problem", "sampler", "seed", "metric", "value"])

    def plot(self, path: Path) -> None:
        rng = np.random.default_rng(0)
        ranks = {name: rng.random(150) for name in "abcdefgh"}
        draw_ranks({"a sampler: no deviation found": ranks}, path)
        with Image.open(path) as one:
            whole = Image.new(one.mode, (one.width, self.blocks * one.height))
            for place in range(self.blocks):
                whole.paste(one, (0, place * one.height))
        whole.save(path)


def test_calibration_is_in_the_page(made, tmp_path):
    page = write_report(made, tmp_path / "report.html", Calibrated(1)).read_text(encoding="utf-8")
    coded = re.search(r'<img[^>]* src="data:image/png;base64,([^"]*)"\s+alt="[^"]', page)
    drawn, shown = tmp_path / "drawn.png", tmp_path / "shown.png"
    Calibrated(1).plot(drawn)
    shown.write_bytes(base64.b64decode(coded[1]))
    # The same picture in fewer bytes.
    off = np.abs(imread(drawn)[..., :3] - imread(shown)[..., :3])
    assert off.mean() < 0.002
    assert off.max() < 0.25
    assert shown.stat().st_size < drawn.stat().st_size / 2
    assert "calibration" in read(page).ids


def test_a_calibration_without_ranks_leaves_the_page_as_it_is(made, tmp_path):
    settings = {"draws": 10, "chains": 1, "workers": 0, "progress": False}
    calibration = calibrate(
        "gait-monocular(frames=4)", ScoreDistillation(), simulations=10, **settings
    )
    assert not calibration.ranked
    page = write_report(made, tmp_path / "report.html", calibration).read_text(encoding="utf-8")
    assert "No sampler has ranks" in page
    assert "sds on gait-monocular" in page
    assert 'class="calibration"' not in page


class Long(Made):
    """Motions of minutes, which fill a page."""

    def __init__(self, folder: Path) -> None:
        walk = make_gait("walk", frames=8700)
        noise = np.random.default_rng(0).normal(size=(1, 1, *walk.positions.shape))
        prior = GaussianMixtureMotion(
            skeleton=walk.skeleton, fps=30.0, means=walk.positions[None], factors=0.02 * noise,
            weights=np.ones(1), noise=0.01, azimuths=1, styles=("walk",),
        )  # fmt: skip
        super().__init__(folder, [Problem("long", "minutes", MotionPosterior(prior))], numbers=1)

    def draws(self, problem: str, sampler: str, seed: int = 0) -> MotionDraws:
        posterior = self.problems[problem].posterior
        drawn = posterior.prior.sample(seeds.generator(seed, problem, sampler), 4)
        return MotionDraws.of(posterior, Named(), drawn[None], seed=seed, seconds=1.0)


def test_no_page_is_heavy(tmp_path):
    long = Long(tmp_path)
    rows = shown_problems(long)["long"].rows
    assert [len(row) for row in rows.values()] == [2, 4, 4]
    assert 0.95 * BUDGET < 2 * sum(row.size for row in rows.values()) < BUDGET
    path = write_report(long, tmp_path / "report.html", Calibrated(18))
    # Of 15 MB; the tables and plots of a larger grid take some.
    assert path.stat().st_size < 13e6

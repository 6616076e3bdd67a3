"""Two people lifted from made videos of synthetic dances."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from live_browser import LiveBrowser

from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.data.synthetic.gaits import make_gait
from probmotion.interaction.annotations import Annotations
from probmotion.io.files import load
from probmotion.lifting import LiftedPairs, lift_pairs
from probmotion.lifting.pair_page import _map
from probmotion.models.unseen_depth import AnnotationPrior
from probmotion.models.unseen_depth.view_cells import OneDirectionError
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person17")
SEED = synthetic_dances(1, seed=11)[0]
DANCE = synthetic_dances(1, frames=330, seed=5)[0]


def filmed(motion: Motion, pixels: float = 200.0) -> list[KeypointTrack]:
    """Return noisy tracks from the front; one in twenty keypoints is wrong, one in ten missing."""
    rng = np.random.default_rng(0)
    points = motion.positions[..., :2] * [pixels, -pixels] + 500.0
    points += 4.0 * rng.standard_normal(points.shape)
    wrong = rng.random(points.shape[:2]) < 0.05
    points[wrong] += 60.0 * rng.standard_normal((int(wrong.sum()), 2))
    confidence = (rng.random(points.shape[:2]) > 0.1).astype(float)
    return [
        KeypointTrack(points[:, rows], confidence[:, rows], PERSON, motion.fps, name="<b>dance")
        for rows in (slice(0, 17), slice(17, 34))
    ]


@pytest.fixture(scope="module")
def lifted() -> LiftedPairs:
    return lift_pairs(filmed(DANCE), SEED, progress=False)


@pytest.fixture(scope="module")
def folder(lifted, tmp_path_factory):
    """Return the folder of a saved lift, whose name is that of the page's placeholder."""
    path = tmp_path_factory.mktemp("FRAME")
    lifted.save(path)
    return path


def errors(positions: np.ndarray) -> np.ndarray:
    """Return differences to the true positions, (L, J, 3), metres, about the pair's middle."""
    truth = DANCE.positions
    return positions - truth - (positions - truth).mean(axis=1, keepdims=True)


def test_smoothing_improves_the_lifts_of_single_frames(lifted):
    own = errors(lifted.prior.lift(lifted.keypoints).positions)
    smoothed = errors(lifted.mean.positions)
    size = np.linalg.norm(smoothed, axis=-1).mean()
    assert size < 0.97 * np.linalg.norm(own, axis=-1).mean()
    assert size < 0.09
    assert np.diff(smoothed, axis=0).std() < 0.5 * np.diff(own, axis=0).std()
    inside = np.abs(smoothed) < 1.645 * lifted.sd
    # Intervals of a prior learnt from all frames would hold 86 % of the depths.
    assert 0.9 < inside.mean() < 0.995
    assert 0.9 < inside[..., 2].mean() < 0.995
    assert abs(lifted.mean.positions.min(axis=1)[:, 1].mean()) < 0.1


def test_outliers_are_left_out_and_short_gaps_filled(lifted):
    # Half of the wrong keypoints are less than 15 cm away.
    assert 0.02 < lifted.outliers < 0.05
    assert np.isfinite(lifted.keypoints).mean() > 0.99
    truth = DANCE.positions[..., :2]
    moved = lifted.keypoints - truth - np.nanmedian(lifted.keypoints - truth, axis=(0, 1))
    assert np.nanquantile(np.linalg.norm(moved, axis=-1), 0.999) < 0.25


def test_outliers_are_left_out_at_low_frame_rates():
    slow = replace(DANCE, positions=DANCE.positions[::6], fps=5.0)
    assert 0.02 < lift_pairs(filmed(slow), SEED, draws=2, progress=False).outliers < 0.1


def test_people_may_be_in_the_other_order(lifted):
    first, second = filmed(DANCE)
    swapped = lift_pairs([second, first], SEED, swap_people=True, progress=False)
    np.testing.assert_allclose(swapped.mean.positions, lifted.mean.positions, atol=1e-6)
    wrong = lift_pairs([second, first], SEED, draws=2, progress=False)
    assert swapped.other_order == pytest.approx(lifted.other_order, abs=1e-3)
    assert wrong.other_order == pytest.approx(-lifted.other_order, abs=0.02)
    assert "compare with --swap-people" in replace(lifted, other_order=0.2).summary()[-1]
    assert not any("--swap-people" in words for words in replace(lifted, other_order=0.0).summary())


def test_files_hold_the_result(lifted, folder):
    assert sorted(path.name for path in folder.iterdir()) == [
        "annotations.npz", "pairs.bvh", "pairs.glb", "pairs.html", "pairs.npz", "prior.npz",
    ]  # fmt: skip
    with np.load(folder / "pairs.npz", allow_pickle=False) as archive:
        np.testing.assert_allclose(archive["sd"], lifted.sd)
        np.testing.assert_allclose(archive["draws"], lifted.draws)
    bvh = load(folder / "pairs.bvh")
    assert len(bvh.skeleton.roots) == 2
    moved = bvh.retarget(lifted.mean.skeleton).positions - lifted.mean.positions
    assert np.linalg.norm(moved, axis=-1).mean() < 0.025
    assert len(Annotations.load(folder / "annotations.npz")) == DANCE.frames
    prior = AnnotationPrior.load(folder / "prior.npz")
    np.testing.assert_array_equal(prior.means, lifted.prior.means)


def test_the_page_shows_each_frame_and_a_command_that_runs(folder, lifted, tmp_path):
    page = folder / "pairs.html"
    assert page.stat().st_size < 1e6
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "<b>dance" not in text
    frame = int(np.flatnonzero(lifted.valid_seeds)[-1])
    code = "document.querySelector('.picture code').textContent"
    picture = "document.querySelector('.picture canvas').toDataURL()"
    with LiveBrowser(page, tmp_path / "profile") as browser:
        go = "(() => {{ const range = document.querySelector('input[type=range]');"
        go += "range.value = {}; range.dispatchEvent(new Event('input')); }})()"
        browser.value(go.format(frame))
        browser.wait_until(f"{code}.includes('[{frame}]')")
        command, seen = browser.value(code), browser.value(picture)
        browser.value(go.format(0))
        browser.wait_until(f"!{code}.includes('[{frame}]')")
        assert browser.value(picture) != seen
        # A click near the dot of another frame shows this frame.
        dots = [int(number) for number in re.findall(r'<circle data-frame="(\d+)"', text)]
        other = dots[len(dots) // 2]
        click = "(() => {{ const dot = document.querySelector('[data-frame=\"{}\"]');"
        click += "const {{ left, top }} = dot.getBoundingClientRect();"
        click += "dot.dispatchEvent(new MouseEvent('click', {{ clientX: left, clientY: top,"
        click += "bubbles: true }})); }})()"
        browser.value(click.format(other))
        browser.wait_until(f"document.querySelector('input[type=range]').value === '{other}'")
        lit = "document.querySelector('.map .shown').dataset.frame"
        browser.wait_until(f"{lit} === '{other}'")
        assert browser.errors() == []
    (data,) = re.findall(r'json">({"fps".*?)</script>', text)
    sd = np.frombuffer(base64.b64decode(json.loads(data)["sds"][0]), "<i2").reshape(-1, 34)
    np.testing.assert_allclose(sd, 1000 * np.linalg.norm(lifted.sd, axis=-1), atol=0.51)
    shown = np.frombuffer(base64.b64decode(json.loads(data)["keypoints"]), "<f4").reshape(-1, 34, 2)
    np.testing.assert_allclose(shown, lifted.keypoints * [1.0, -1.0], atol=1e-5)
    assert command.endswith('"mh")')
    scope: dict[str, object] = {}
    exec(
        command.replace('"mh"', '"mh", draws=2, chains=1, warmup=0, thin=1, progress=False'), scope
    )
    draws = scope["draws"].flat()
    assert np.linalg.norm(draws[0, 0] - lifted.mean.positions[frame], axis=-1).mean() < 0.2


def test_the_map_has_similar_pairs_close_to_each_other():
    """Every second frame of two kinds of pairs is shown; in the others, pairs are reflected."""
    poses = np.repeat(DANCE.positions[[0, 150]], 10, axis=0)
    poses += 0.01 * np.random.default_rng(0).normal(size=poses.shape)
    poses[1::2] *= [-1.0, 1.0, 1.0]
    dots = re.findall(r'frame="(\d+)" cx="([^"]+)" cy="([^"]+)"', _map(poses, 2))
    frames, points = [int(dot[0]) for dot in dots], np.array([dot[1:] for dot in dots], float)
    assert frames == list(range(10))
    assert (np.abs(points) <= [95.1, 70.1]).all()
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    assert max(apart[:5, :5].max(), apart[5:, 5:].max()) < 0.5 * apart[:5, 5:].min()


def test_the_command_of_a_relative_page_has_absolute_paths(lifted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = lifted.report("page.html").read_text(encoding="utf-8")
    assert f"pm.load('{(tmp_path.resolve() / 'pairs.npz').as_posix()}')" in text


@pytest.mark.parametrize("error", [OneDirectionError("one"), np.linalg.LinAlgError("singular")])
def test_only_one_direction_makes_the_other_order_impossible(lifted, monkeypatch, error):
    own = AnnotationPrior.fit
    calls = []

    def fit(*arguments, **options):
        calls.append(arguments)
        if len(calls) == 2:
            raise error
        return own(*arguments, **options)

    monkeypatch.setattr(AnnotationPrior, "fit", fit)
    if isinstance(error, OneDirectionError):
        assert lift_pairs(TRACKS, SEED, draws=2, progress=False).other_order == -np.inf
    else:
        with pytest.raises(np.linalg.LinAlgError, match="singular"):
            lift_pairs(TRACKS, SEED, draws=2, progress=False)


def test_pairs_have_the_name_of_the_video():
    tracks = [
        replace(track, name=f"a tango {n}") for track, n in zip(TRACKS, (10, 11), strict=True)
    ]
    result = lift_pairs(tracks, SEED, draws=2, progress=False)
    assert result.mean.name == "a tango"
    assert set(result.annotations.sources) == {"a tango"}


def test_frames_whose_angles_are_beyond_the_limits_cannot_be_started_from(lifted, tmp_path):
    positions = lifted.mean.positions.copy()
    positions[7] = positions[7] * [1.0, 1.0, -1.0]  # reflected: knees and elbows bend backwards
    broken = replace(lifted, mean=replace(lifted.mean, positions=positions))
    assert not broken.valid_seeds[7]
    text = broken.report(tmp_path / "page.html").read_text(encoding="utf-8")
    (content,) = re.findall(r'json">({"step".*?)</script>', text)
    assert json.loads(content)["seeds"][7] == 0
    with pytest.raises(ValueError, match="end in"):
        broken.report(tmp_path / "page.txt")


TRACKS = filmed(DANCE)
STILL = replace(DANCE, positions=np.repeat(DANCE.positions[:1], DANCE.frames, axis=0))
FAR = replace(SEED, positions=SEED.positions + np.repeat([0.0, 9.0], 17)[:, None] * [1, 0, 0])
ANIMAL = Skeleton([f"j{joint}" for joint in range(17)], PERSON.parents)
LEGLESS = replace(
    TRACKS[1], confidence=TRACKS[1].confidence * (np.arange(17) != PERSON.index("left_ankle"))
)
DOUBTFUL = [
    replace(
        track,
        confidence=track.confidence * np.where(np.arange(DANCE.frames) < 100, 1, 0.29)[:, None],
    )
    for track in TRACKS
]
SHORT = [
    replace(track, keypoints=track.keypoints[:90], confidence=track.confidence[:90])
    for track in TRACKS
]


@pytest.mark.parametrize(
    ("tracks", "start", "message"),
    [
        (TRACKS[:1], SEED, "tracks must be of two people, got 1"),
        ([*TRACKS, TRACKS[0]], SEED, r"of two people, got 3; .* two \(--persons I J\)"),
        (SHORT, SEED, r"at least 10 s with a confidence of at least 0\.3, got 3.0 s"),
        (DOUBTFUL, SEED, r"at least 10 s with a confidence of at least 0\.3, got 3.3 s"),
        (filmed(STILL), SEED, "from several directions, got one direction only: .*--swap-people"),
        ([TRACKS[0], LEGLESS], SEED, "at least 0.3, got none of person1:left_ankle"),
        (TRACKS, FAR, "people in seed must be at most 5 m apart"),
        (TRACKS, make_gait("walk", frames=2), "motion must have 2 roots, one per person, got 1"),
        ([replace(track, skeleton=ANIMAL) for track in TRACKS], SEED, "have all limb keypoints"),
    ],
)
def test_what_cannot_be_lifted_is_named(tracks, start, message):
    with pytest.raises(ValueError, match=message):
        lift_pairs(tracks, start, progress=False)

"""The motion VAEs that ship: people and animals, learnt from pictures alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import MotionPosterior, compare, models
from probmotion.data.projections import centre_motion
from probmotion.data.synthetic.animals import animal_clips, synthetic_animals
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.synthetic.walks import walk_clips
from probmotion.data.tracks.learning import film_windows
from probmotion.metrics.measures import measure
from probmotion.models import MotionVAE
from probmotion.models.vae.view_hypotheses import judge_hypotheses
from probmotion.motion.distances import nearest_distances, windows
from probmotion.posteriors.sampling import UnsupportedPosterior, load_sampler
from probmotion.problems import load_problem
from probmotion.samplers import MultiViewAncestral

WEIGHTS = Path(models.__file__).parent / "weights"
NAMES = ("walk-vae", "animal-vae")


@pytest.mark.parametrize("name", NAMES)
def test_what_ships_is_small_and_says_what_it_is(name: str) -> None:
    files = {file.name for file in WEIGHTS.glob(f"{name}*")}
    assert files == {
        f"{name}.md", f"{name}.safetensors", f"{name}-evaluator.safetensors",
        f"{name}-features.npz",
    }  # fmt: skip
    assert sum((WEIGHTS / file).stat().st_size for file in files) < 8e6
    card = (WEIGHTS / f"{name}.md").read_text(encoding="utf-8")
    for words in ("MIT licence", "depth right", "Not for"):
        assert words in card
    network = MotionVAE.load(name).card["network"]
    seen = {*network["data"]["clips"], *network["validation_data"]["clips"]}
    assert not seen & {"humanoid3d_long_walk3", "humanoid3d_stealthy_walk", "dog3d_trot"}


def test_a_body_that_was_never_measured_has_bones_of_the_right_length() -> None:
    prior = MotionVAE.load("walk-vae")
    rest = prior.body.rest
    for joint, length in (("left_knee", 0.42), ("right_knee", 0.42), ("left_ankle", 0.41)):
        found = np.linalg.norm(rest[prior.skeleton.index(joint)])
        assert found == pytest.approx(length, abs=0.03)


@pytest.mark.parametrize("name", NAMES)
def test_the_right_view_is_chosen_for_bodies_of_the_same_kind(name: str) -> None:
    prior = MotionVAE.load(name)
    walks = make_gaits(4, styles={"walk": 1.0}, frames=90, seed=5)
    clips = walks if name == "walk-vae" else synthetic_animals(4, seed=5)
    judged = judge_hypotheses(prior.model.pose, prior.settings, prior.body, clips, n=300)
    assert judged.depth_right > 0.9
    assert judged.right > 0.9
    assert judged.error < 1.1 * judged.least_error


@pytest.mark.parametrize("name", NAMES)
def test_it_can_be_simulated(name: str) -> None:
    """There is no evidence: another truth is another draw of the prior."""
    problem = load_problem(name)
    again = problem.simulate(3)
    assert again.posterior.likelihood is None
    np.testing.assert_array_equal(again.truth, problem.simulate(3).truth)
    assert (again.truth != problem.simulate(4).truth).any()


@pytest.mark.parametrize("name", NAMES)
def test_draws_are_nearer_to_held_out_motion_than_a_still_body_is(name: str, real_data) -> None:
    prior = MotionVAE.load(name)
    clips = (walk_clips if name == "walk-vae" else animal_clips)(real_data)["test"]
    motions = [centre_motion(clip.retarget(prior.skeleton).resample(prior.fps)) for clip in clips]
    real = np.concatenate([windows(motion.positions, prior.frames, 3) for motion in motions])
    drawn = prior.sample(np.random.default_rng(0), 300)
    still = np.broadcast_to(drawn.mean(axis=(0, 1)), drawn[:1].shape)
    ours, theirs = nearest_distances(drawn, real), nearest_distances(still, real)
    # Draws move, if more calmly than real motion does.
    pace = [np.linalg.norm(np.diff(motion, axis=1), axis=-1).mean() for motion in (drawn, real)]
    assert 0.3 < pace[0] / pace[1] < 2
    # Of real motions, how far the nearest draw is: a mean pose is far from most of them.
    assert ours[1] < 0.8 * theirs[1]


def test_views_that_were_held_out_are_compared_with_where_a_problem_has_them() -> None:
    blind = load_problem("animal-vae")
    made = synthetic_animals(3, seed=5)
    prior = blind.posterior.prior
    views = film_windows(made, prior.skeleton, prior.fps, prior.frames, 100, seed=0)
    problem = replace(blind, generation=replace(blind.generation, held_out_views=views))
    draws = load_sampler("exact")().sample(problem.posterior, draws=40, progress=False)
    found = measure(problem, draws, 0)
    without = {name: value for name, value in found.items() if name != "mcd_cm2"}
    assert measure(blind, draws, 0) == without
    still = draws.flat().mean(axis=(0, 1), keepdims=True).repeat(prior.frames, axis=1)
    assert found["mcd_cm2"] < 1e4 * problem.generation.chamfer(still, seed=0).mean
    # The prior's own draws are the reference.
    assert 0.7 < found["swd_ratio"] < 1.4


def test_compare_draws_from_it_by_every_kind_of_sampler() -> None:
    samplers = {"sds": {"iterations": 20}, "mh": {"warmup": 50}, "dvae": {}}
    made = {name: load_sampler(name)(**given) for name, given in samplers.items()}
    table = compare(
        "walk-vae-monocular", made, draws=20, seeds=1, progress=False, workers=0
    ).table()
    found = table[table["metric"] == "mpjpe_mm"].set_index("sampler")["value"]
    assert set(found.index) == set(samplers)
    assert np.isfinite(found).all()


def test_generation_is_measured_against_real_pictures() -> None:
    problem = load_problem("walk-vae")
    prior = problem.posterior.prior
    drawn = prior.sample(np.random.default_rng(0), 200)
    still = np.repeat(prior.motion(np.zeros((1, prior.dim))), 200, axis=0)
    scores = [problem.generation.score_motions(m, seed=0)["fid"][0] for m in (drawn, still)]
    assert scores[0] < 0.5 * scores[1]


def test_mas_says_what_is_missing() -> None:
    with pytest.raises(UnsupportedPosterior, match="Denoises2D"):
        MultiViewAncestral().sample(MotionPosterior(MotionVAE.load("walk-vae")), draws=1)

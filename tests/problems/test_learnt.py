"""The problem of the prior that ships: people who walk, learnt from pictures alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Cameras, Keypoints2D, MotionPosterior, compare, models
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.data.projections import centre_motion
from probmotion.data.synthetic.walks import synthetic_walks, walk_clips
from probmotion.metrics.measures import measure
from probmotion.motion.distances import mirrored_fraction, nearest_distances, windows
from probmotion.problems import load_problem
from probmotion.samplers import NUTS, MultiViewAncestral, ScoreDistillation

WEIGHTS = Path(models.__file__).parent / "weights"


@pytest.fixture(scope="module")
def problem():
    return load_problem("walk2d")


@pytest.fixture(scope="module")
def draws(problem):
    sampler = MultiViewAncestral(steps=20, trained_steps=100, perspective=True)
    return sampler.sample(problem.posterior, draws=24, seed=0, progress=False)


def test_what_ships_is_small_and_says_what_it_is():
    files = list(WEIGHTS.glob("walk2d*"))
    assert {file.name for file in files} == {
        "walk2d.md", "walk2d.safetensors", "walk2d-evaluator.safetensors", "walk2d-features.npz",
    }  # fmt: skip
    assert sum(file.stat().st_size for file in files) < 8e6
    card = (WEIGHTS / "walk2d.md").read_text(encoding="utf-8")
    for words in ("Learnt from: cmu_02_01", "Held out: humanoid3d_long_walk3", "MIT", "NSF"):
        assert words in card


def test_it_learnt_from_no_clip_that_is_held_out(problem):
    network = problem.posterior.prior.card["network"]
    seen = set(network["data"]["clips"]) | set(network["validation_data"]["clips"])
    assert not seen & {"humanoid3d_long_walk3", "humanoid3d_stealthy_walk"}
    assert network["data"]["clips"] == problem.generation.evaluator.card["network"]["data"]["clips"]


def test_bodies_come_out_of_pictures(problem, draws):
    """No one told the prior that bones are rigid, or how long: two views cannot both be wrong."""
    skeleton = problem.posterior.skeleton
    motions = draws.flat()
    for joint, length in (("left_knee", 0.42), ("right_knee", 0.42), ("left_ankle", 0.41)):
        number = skeleton.index(joint)
        bone = motions[:, :, number] - motions[:, :, skeleton.parents[number]]
        lengths = np.linalg.norm(bone, axis=-1)
        assert lengths.mean() == pytest.approx(length, abs=0.02)
        assert lengths.std(axis=1).mean() < 0.03


def test_draws_are_as_near_to_held_out_motion_as_real_motion_is(problem, draws, real_data):
    """The prior saw pictures of the training clips; their third dimension is as far from new ones.

    Seen from 2D alone a motion and its reflection in depth are alike; views above the horizon are
    what tells knees that bend forwards.
    """
    prior = problem.posterior.prior
    learnt, real = (
        np.concatenate(
            [
                windows(centre_motion(clip.retarget(prior.skeleton).resample(20)).positions, 40, 8)
                for clip in walk_clips(real_data)[part]
            ]
        )
        for part in ("train", "test")
    )
    near = nearest_distances(draws.flat(), real)
    assert near.of_draws < 1.15 * nearest_distances(learnt, real).of_draws
    reflected = draws.flat() * np.array([1.0, 1.0, -1.0])
    assert near.of_draws < 0.9 * nearest_distances(reflected, real).of_draws
    assert mirrored_fraction(draws.flat(), real) < 0.1


def test_measures_tell_draws_from_noise_and_from_one_motion(problem, draws):
    found = measure(problem, draws, 0)
    assert found["fid"] > 0
    assert 0.5 < found["diversity_ratio"] < 1.5
    reference = problem.generation
    rng = np.random.default_rng(0)
    motions = draws.flat()
    shaken = motions + 0.1 * rng.standard_normal(motions.shape)
    same = np.repeat(motions[:1], len(motions), axis=0)
    for worse in (shaken, same):
        scores = reference.score_motions(worse, seed=0)
        assert scores["fid"][0] > 2 * found["fid"]


def test_compare_runs_it_with_no_download(tmp_path):
    samplers = {
        "mas": MultiViewAncestral(steps=3),
        "sds": ScoreDistillation(iterations=3),
        "nuts": NUTS(),
    }
    table = compare(
        "walk2d", samplers, draws=12, chains=2, out=tmp_path, workers=0, progress=False
    ).table()
    kept = table.pivot_table(index="sampler", columns="metric", values="value")
    assert set(kept["fid"].dropna().index) == {"mas", "sds"}
    text = str(table)
    assert "filmed, against real" in text
    assert "FID: Fréchet distance" in text
    assert "nuts on walk2d: nuts needs a prior with HasLogDensity" in text


def test_a_network_is_told_from_another_by_its_weights(problem):
    prior = problem.posterior.prior
    before = fingerprint(prior)
    prior.denoise(np.zeros((1, 2, 40, 14, 2)), 0.5, None)
    assert fingerprint(prior) == before
    other = models.MotionDiffusion.load("walk2d")
    assert fingerprint(other) == before
    assert fingerprint(other.of_length(20)) != before
    with_torch = next(other._network.parameters())
    with_torch.data[0, 0] += 1
    assert fingerprint(other) != before


def test_evidence_of_a_motion_that_travels_is_refused(problem):
    """The prior's pelvis is at the origin in every frame, because its pictures were centred so."""
    prior = problem.posterior.prior
    walk = make_walks_on(prior)
    camera = Cameras.ring(1, elevation=0.2)
    evidence = Keypoints2D.observe(centre_motion(walk), camera, noise=0.02, seed=0)
    assert MotionPosterior(prior, evidence).likelihood is evidence
    travelling = replace(walk, positions=walk.positions + np.linspace(0, 2, 40)[:, None, None])
    wrong = Keypoints2D.observe(travelling.centred(), camera, noise=0.02, seed=0)
    with pytest.raises(ValueError, match=r"likelihood has the pelvis up to \d+ standard"):
        MotionPosterior(prior, wrong)


def make_walks_on(prior):
    """Return a made walk on the prior's joints, as long as its motions."""
    return (
        synthetic_walks(1)[0].retarget(prior.skeleton).resample(prior.fps).window(0, prior.frames)
    )

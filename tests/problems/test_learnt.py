"""Shipped priors learnt from 2D tracks: motion diffusion and motion VAEs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Cameras, Keypoints2D, MotionPosterior, compare, models
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.data.projections import centre_motion
from probmotion.data.synthetic.animals import animal_clips, synthetic_animals
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.synthetic.walks import synthetic_walks, walk_clips
from probmotion.data.tracks.learning import film_windows
from probmotion.metrics.measures import measure
from probmotion.models import MotionVAE
from probmotion.models.vae.view_hypotheses import evaluate_hypotheses
from probmotion.motion.distances import mirrored_fraction, nearest_distances, windows
from probmotion.posteriors.sampling import load_sampler
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


def test_shipped_files_and_model_card():
    files = list(WEIGHTS.glob("walk2d*"))
    assert {file.name for file in files} == {
        "walk2d.md", "walk2d.safetensors", "walk2d-evaluator.safetensors", "walk2d-features.npz",
    }  # fmt: skip
    assert sum(file.stat().st_size for file in files) < 8e6
    card = (WEIGHTS / "walk2d.md").read_text(encoding="utf-8")
    for words in ("Learnt from: cmu_02_01", "Held out: humanoid3d_long_walk3", "MIT", "NSF"):
        assert words in card


def test_training_excludes_held_out_clips(problem):
    network = problem.posterior.prior.card["network"]
    seen = set(network["data"]["clips"]) | set(network["validation_data"]["clips"])
    assert not seen & {"humanoid3d_long_walk3", "humanoid3d_stealthy_walk"}
    assert network["data"]["clips"] == problem.generation.evaluator.card["network"]["data"]["clips"]


def test_bones_are_rigid_with_correct_lengths(problem, draws):
    skeleton = problem.posterior.skeleton
    motions = draws.flat()
    for joint, length in (("left_knee", 0.42), ("right_knee", 0.42), ("left_ankle", 0.41)):
        number = skeleton.index(joint)
        bone = motions[:, :, number] - motions[:, :, skeleton.parents[number]]
        lengths = np.linalg.norm(bone, axis=-1)
        assert lengths.mean() == pytest.approx(length, abs=0.02)
        assert lengths.std(axis=1).mean() < 0.03


def test_draws_are_as_close_to_held_out_motion_as_training_motion(problem, draws, real_data):
    """Depth reflections have larger errors, as views above the horizon resolve the depth."""
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


def test_metrics_distinguish_draws_from_noise_and_repetition(problem, draws):
    found = measure(problem, draws, 0)
    assert found["fid"] > 0
    assert 0.5 < found["diversity_ratio"] < 1.5
    reference = problem.generation
    rng = np.random.default_rng(0)
    motions = draws.flat()
    noisy = motions + 0.1 * rng.standard_normal(motions.shape)
    repeated = np.repeat(motions[:1], len(motions), axis=0)
    for worse in (noisy, repeated):
        scores = reference.score_motions(worse, seed=0)
        assert scores["fid"][0] > 2 * found["fid"]


def test_compare_works_without_downloads(tmp_path):
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
    assert "2D views against real" in text
    assert "FID: Fréchet distance" in text
    assert "nuts on walk2d: nuts needs a prior with HasLogDensity" in text


def test_fingerprint_depends_on_weights(problem):
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


def test_observations_of_travelling_motion_are_rejected(problem):
    """The prior's pelvis is at the origin in every frame."""
    prior = problem.posterior.prior
    walk = synthetic_walk(prior)
    camera = Cameras.ring(1, elevation=0.2)
    likelihood = Keypoints2D.observe(centre_motion(walk), camera, noise=0.02, seed=0)
    assert MotionPosterior(prior, likelihood).likelihood is likelihood
    travelling = replace(walk, positions=walk.positions + np.linspace(0, 2, 40)[:, None, None])
    wrong = Keypoints2D.observe(travelling.centred(), camera, noise=0.02, seed=0)
    with pytest.raises(
        ValueError, match=r"likelihood must have the pelvis at the origin, .* up to \d+ standard"
    ):
        MotionPosterior(prior, wrong)


def synthetic_walk(prior):
    return (
        synthetic_walks(1)[0].retarget(prior.skeleton).resample(prior.fps).window(0, prior.frames)
    )


NAMES = ("walk-vae", "animal-vae")


@pytest.mark.parametrize("name", NAMES)
def test_vae_files_and_model_card(name):
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


def test_estimated_rest_pose_has_correct_bone_lengths():
    prior = MotionVAE.load("walk-vae")
    rest = prior.body.rest
    for joint, length in (("left_knee", 0.42), ("right_knee", 0.42), ("left_ankle", 0.41)):
        found = np.linalg.norm(rest[prior.skeleton.index(joint)])
        assert found == pytest.approx(length, abs=0.03)


@pytest.mark.parametrize("name", NAMES)
def test_view_selection_is_accurate(name):
    prior = MotionVAE.load(name)
    walks = make_gaits(4, styles={"walk": 1.0}, frames=90, seed=5)
    clips = walks if name == "walk-vae" else synthetic_animals(4, seed=5)
    judged = evaluate_hypotheses(prior.model.pose, prior.settings, prior.body, clips, n=300)
    assert judged.depth_right > 0.9
    assert judged.right > 0.9
    assert judged.error < 1.1 * judged.least_error


@pytest.mark.parametrize("name", NAMES)
def test_draws_are_closer_to_held_out_motion_than_a_still_body(name, real_data):
    prior = MotionVAE.load(name)
    clips = (walk_clips if name == "walk-vae" else animal_clips)(real_data)["test"]
    motions = [centre_motion(clip.retarget(prior.skeleton).resample(prior.fps)) for clip in clips]
    real = np.concatenate([windows(motion.positions, prior.frames, 3) for motion in motions])
    drawn = prior.sample(np.random.default_rng(0), 300)
    still = np.broadcast_to(drawn.mean(axis=(0, 1)), drawn[:1].shape)
    ours, theirs = nearest_distances(drawn, real), nearest_distances(still, real)
    # Draws move at a speed similar to real motion.
    pace = [np.linalg.norm(np.diff(motion, axis=1), axis=-1).mean() for motion in (drawn, real)]
    assert 0.3 < pace[0] / pace[1] < 2
    # Distance of real motions to the closest draw.
    assert ours[1] < 0.8 * theirs[1]


def test_held_out_views_add_the_chamfer_distance():
    plain = load_problem("animal-vae")
    made = synthetic_animals(3, seed=5)
    prior = plain.posterior.prior
    views = film_windows(made, prior.skeleton, prior.fps, prior.frames, 40, seed=0)
    problem = replace(plain, generation=replace(plain.generation, held_out_views=views))
    draws = load_sampler("exact")().sample(problem.posterior, draws=40, progress=False)
    found = measure(problem, draws, 0)
    without = {name: value for name, value in found.items() if name != "mcd_cm2"}
    assert measure(plain, draws, 0) == without
    still = draws.flat().mean(axis=(0, 1), keepdims=True).repeat(prior.frames, axis=1)
    assert found["mcd_cm2"] < 1e4 * problem.generation.chamfer(still, seed=0).mean
    # Exact draws have the reference distribution.
    assert 0.7 < found["swd_ratio"] < 1.4


def test_fid_distinguishes_draws_from_a_still_body():
    problem = load_problem("walk-vae")
    prior = problem.posterior.prior
    drawn = prior.sample(np.random.default_rng(0), 200)
    still = np.repeat(prior.motion(np.zeros((1, prior.dim))), 200, axis=0)
    scores = [problem.generation.score_motions(m, seed=0)["fid"][0] for m in (drawn, still)]
    assert scores[0] < 0.5 * scores[1]

"""Shipped priors learnt from 2D tracks: motion diffusion and motion VAEs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Cameras, Keypoints2D, MotionPosterior, compare, models
from probmotion.data.person_clips import clips_of_actions
from probmotion.data.projections import centre_motion
from probmotion.data.synthetic.animals import VARIED_TRUNKS, animal_clips, synthetic_animals
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.synthetic.walks import synthetic_walks, walk_clips
from probmotion.data.tracks.learning import film_windows
from probmotion.metrics.generation import frechet_distance
from probmotion.metrics.measures import measure
from probmotion.models import MotionVAE
from probmotion.models.vae.view_hypotheses import evaluate_hypotheses
from probmotion.motion.distances import mirrored_fraction, nearest_distances, windows
from probmotion.posteriors.sampling import load_sampler
from probmotion.problems import load_problem
from probmotion.samplers import NUTS, MultiViewAncestral
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.noise_levels import Cosine

WEIGHTS = Path(models.__file__).parent / "weights"
DIFFUSION = ("walk2d", "motion2d")


@pytest.fixture(scope="module")
def problem():
    return load_problem("walk2d")


@pytest.fixture(scope="module")
def draws(problem):
    sampler = MultiViewAncestral(steps=20, levels=Cosine(trained_steps=100), perspective=True)
    return sampler.sample(problem.posterior, draws=24, seed=0, progress=False)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("walk2d", ("Training clips: cmu_02_01", "Test clips: humanoid3d_long_walk3", "NSF")),
        ("motion2d", ("Training clips: cmu_01_01", "Test clips: cmu_02_02", "NSF", "Not for")),
        ("walk-vae", ("MIT licence", "correct depth", "Not for")),
        ("animal-vae", ("MIT licence", "correct depth", "Not for")),
    ],
)
def test_shipped_files_and_held_out_clips(name, words):
    files = {file.name: file.stat().st_size for file in WEIGHTS.glob(f"{name}*")}
    endings = (".md", ".safetensors", "-evaluator.safetensors", "-features.npz")
    assert set(files) == {name + ending for ending in endings}
    assert sum(files.values()) < 8e6
    card = (WEIGHTS / f"{name}.md").read_text(encoding="utf-8")
    for word in words:
        assert word in card
    problem = load_problem(name)
    network = problem.posterior.prior.card["network"]
    clips = {*network["data"]["clips"], *network["validation_data"]["clips"]}
    assert not clips & {"humanoid3d_long_walk3", "humanoid3d_stealthy_walk", "dog3d_trot"}
    if name == "motion2d":
        held_out = clips_of_actions("walking", "running", "jumping")["test"]
        assert not clips & {clip.rpartition("/")[2] for clip in held_out}
    if name in DIFFUSION:
        evaluator = problem.generation.evaluator.card["network"]
        assert network["data"]["clips"] == evaluator["data"]["clips"]


@pytest.mark.slow
@pytest.mark.parametrize("name", DIFFUSION)
def test_2d_draws_are_almost_as_close_to_held_out_clips_as_training_clips(name):
    """The Fréchet distance is at most 1.5 times theirs; that of draws at half the speed is not."""
    problem = load_problem(name)
    views = Ancestral2D().sample_views(problem.posterior, draws=128, seed=0, progress=False)
    half = views.shape[1] // 2
    reference = problem.generation
    ours, training, slow = (
        frechet_distance(features, reference.held_out_features)
        for features in (
            reference.evaluator.features(views),
            reference.learnt_features[:128],
            reference.evaluator.features(np.repeat(views[:, :half], 2, axis=1)),
        )
    )
    assert ours < 1.5 * training < slow


def test_bones_are_rigid_with_correct_lengths(problem, draws):
    skeleton, motions = problem.posterior.skeleton, draws.flat()
    for name, length in (("left_knee", 0.42), ("right_knee", 0.42), ("left_ankle", 0.41)):
        joint = skeleton.index(name)
        bone = motions[:, :, joint] - motions[:, :, skeleton.parents[joint]]
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
    reflected = draws.flat() * np.array([1.0, 1.0, -1.0])
    ours, training, reflections = (
        nearest_distances(motions, real).of_draws for motions in (draws.flat(), learnt, reflected)
    )
    assert ours < min(1.15 * training, 0.9 * reflections)
    assert mirrored_fraction(draws.flat(), real) < 0.1


def test_metrics_distinguish_draws_from_noise_and_repetition(problem, draws):
    metrics, motions = measure(problem, draws, 0), draws.flat()
    assert metrics["fid"] > 0
    assert 0.5 < metrics["diversity_ratio"] < 1.5
    noisy = motions + 0.1 * np.random.default_rng(0).standard_normal(motions.shape)
    repeated = np.repeat(motions[:1], len(motions), axis=0)
    for worse in (noisy, repeated):
        scores = problem.generation.score_motions(worse, seed=0)
        assert scores["fid"][0] > 2 * metrics["fid"]


def test_compare_works_without_downloads(tmp_path):
    samplers = {"mas": MultiViewAncestral(steps=3), "nuts": NUTS()}
    options = {"draws": 12, "chains": 2, "out": tmp_path, "workers": 0, "progress": False}
    table = compare("walk2d", samplers, **options).table()
    values = table.pivot_table(index="sampler", columns="metric", values="value")
    assert set(values["fid"].dropna().index) == {"mas"}
    text = str(table)
    assert "2D views against real" in text
    assert "FID: Fréchet distance" in text
    assert "nuts on walk2d: nuts needs a prior with HasLogDensity" in text


def test_observations_of_travelling_motion_are_rejected(problem):
    """The prior's pelvis is at the origin in every frame."""
    prior, camera = problem.posterior.prior, Cameras.ring(1, elevation=0.2)
    walk = synthetic_walks(1)[0].retarget(prior.skeleton).resample(prior.fps).window(0, 40)
    likelihood = Keypoints2D.observe(centre_motion(walk), camera, noise=0.02, seed=0)
    assert MotionPosterior(prior, likelihood).likelihood is likelihood
    travelling = replace(walk, positions=walk.positions + np.linspace(0, 2, 40)[:, None, None])
    wrong = Keypoints2D.observe(travelling.centred(), camera, noise=0.02, seed=0)
    message = r"likelihood must have the pelvis at the origin, .* up to \d+ standard"
    with pytest.raises(ValueError, match=message):
        MotionPosterior(prior, wrong)


NAMES = ("walk-vae", "animal-vae")


def test_estimated_rest_pose_has_correct_bone_lengths():
    prior = MotionVAE.load("walk-vae")
    joints = [prior.skeleton.index(name) for name in ("left_knee", "right_knee", "left_ankle")]
    lengths = np.linalg.norm(prior.body.rest[joints], axis=-1)
    np.testing.assert_allclose(lengths, [0.42, 0.42, 0.41], atol=0.03)


@pytest.mark.parametrize("name", NAMES)
def test_view_selection_is_accurate(name):
    prior = MotionVAE.load(name)
    walks = make_gaits(4, styles={"walk": 1.0}, frames=90, seed=5)
    clips = walks if name == "walk-vae" else synthetic_animals(4, seed=5)
    result = evaluate_hypotheses(prior.model.pose, prior.settings, prior.body, clips, n=300)
    assert min(result.depth_right, result.right) > 0.9
    assert result.error < 1.1 * result.least_error


@pytest.mark.parametrize("name", NAMES)
def test_draws_are_closer_to_held_out_motion_than_a_static_body(name, real_data):
    prior = MotionVAE.load(name)
    parts = {
        "walk-vae": lambda: walk_clips(real_data),
        "animal-vae": lambda: animal_clips(real_data, trunks=VARIED_TRUNKS),
    }
    clips = parts[name]()["test"]
    motions = [centre_motion(clip.retarget(prior.skeleton).resample(prior.fps)) for clip in clips]
    real = np.concatenate([windows(motion.positions, prior.frames, 3) for motion in motions])
    drawn = prior.sample(np.random.default_rng(0), 300)
    static = np.broadcast_to(drawn.mean(axis=(0, 1)), drawn[:1].shape)
    speeds = [np.linalg.norm(np.diff(motion, axis=1), axis=-1).mean() for motion in (drawn, real)]
    assert 0.3 < speeds[0] / speeds[1] < 2
    # Compare the distances of real motions to the closest draw.
    assert nearest_distances(drawn, real)[1] < 0.8 * nearest_distances(static, real)[1]


def test_held_out_views_add_the_chamfer_distance():
    plain = load_problem("animal-vae")
    prior = plain.posterior.prior
    animals = synthetic_animals(2, 45, seed=5)
    views = film_windows(animals, prior.skeleton, prior.fps, prior.frames, 40, seed=0)
    problem = replace(plain, generation=replace(plain.generation, held_out_views=views))
    draws = load_sampler("exact")().sample(problem.posterior, draws=40, progress=False)
    metrics = measure(problem, draws, 0)
    static = draws.flat().mean(axis=(0, 1), keepdims=True).repeat(prior.frames, axis=1)
    assert metrics["mcd_cm2"] < 1e4 * problem.generation.chamfer(static, seed=0).mean
    # Exact draws have the reference distribution.
    assert 0.7 < metrics["swd_ratio"] < 1.4


def test_fid_distinguishes_draws_from_a_static_body():
    problem = load_problem("walk-vae")
    prior = problem.posterior.prior
    drawn = prior.sample(np.random.default_rng(0), 200)
    static = np.repeat(prior.motion(np.zeros((1, prior.dim))), 200, axis=0)
    scores = [problem.generation.score_motions(m, seed=0)["fid"][0] for m in (drawn, static)]
    assert scores[0] < 0.5 * scores[1]

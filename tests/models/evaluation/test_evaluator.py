"""Evaluator: features of single motions, style separation, training loss and checkpoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.gaits import make_gait
from probmotion.metrics.filming import film_motions
from probmotion.metrics.generation import EncodesViews, GenerationReference
from probmotion.models.evaluation.evaluator import KIND, EvaluatorSettings, TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.track_autoencoder import TrackAutoencoder, divergence_from_normal
from probmotion.models.training import checkpoints
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train

FRAMES = 16
STYLES = ("walk", "run")
SIZE = EvaluatorSettings.tiny(FRAMES)
CPU = torch.device("cpu")


def positions_of(style, numbers):
    clips = [make_gait(style, number, frames=24) for number in numbers]
    return np.stack([clip.positions[:FRAMES] for clip in clips])


def tracks_of(numbers):
    clips = [make_gait(style, number, frames=24) for style in STYLES for number in numbers]
    return project_clips(clips, views=4, noise=DetectorNoise.none())


def views_of(style, numbers, seed=0):
    return film_motions(positions_of(style, numbers), np.random.default_rng(seed))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Result of a short training run."""
    data = tracks_of(range(12)), tracks_of(range(12, 16))
    losses = []
    for seed in (1, 0, 0):
        trainee = EvaluatorTrainee(*data, SIZE, seed=seed)
        with torch.no_grad():
            losses.append(trainee.validation_loss(trainee.network, CPU))
    assert losses[0] != losses[1] == losses[2]
    settings = TrainingSettings(
        steps=120, batch=24, learning_rate=3e-3, warmup=10, ema=0.9, checkpoint_every=60
    )
    result = train(trainee, settings, tmp_path_factory.mktemp("run"), progress=False)
    # An uninformative autoencoder has a loss of about 1.
    assert losses[2] > 0.9
    assert result.history[-1]["validation_loss"] < 0.75 * losses[2]
    return result


@pytest.fixture(scope="module")
def evaluator(run):
    return TrackEvaluator.load(run.model.parent)


@pytest.fixture(scope="module")
def views():
    return views_of("walk", range(30, 42))


def test_features_do_not_depend_on_the_batch(evaluator, views):
    features = evaluator.features(np.concatenate([views] * 10))
    assert features.shape == (120, SIZE.latent)
    assert features.dtype == np.float64
    # A chunk has 56 motions, so copies are at different positions in chunks.
    np.testing.assert_array_equal(features, np.tile(features[:12], (10, 1)))
    np.testing.assert_array_equal(evaluator.features(views[7:8]), features[7:8])
    assert evaluator.features(views[:0]).shape == (0, SIZE.latent)


def test_padding_has_no_effect(evaluator, views):
    lengths = np.arange(4, 16)
    padded = views.copy()
    for motion, length in zip(padded, lengths, strict=True):
        motion[length:] = np.nan
    features = evaluator.features(padded, lengths)
    for number, length in enumerate(lengths):
        single = evaluator.features(views[number : number + 1, :length])
        np.testing.assert_array_equal(features[number : number + 1], single)
    assert np.abs(features - evaluator.features(views)).min(axis=1).max() > 1e-3


def test_features_are_the_mean_of_the_encoder(evaluator, run, views):
    stored = load_checkpoint(run.model, KIND)
    network = TrackAutoencoder(SIZE, 17).eval()
    network.load_state_dict(dict(stored.tensors))
    mean, deviation = (np.array(stored.settings["network"][name]) for name in ("mean", "deviation"))
    assert (deviation[0] == 0).all()
    standardised = (views[0] - mean) / np.where(deviation > 0, deviation, np.inf)
    motion = torch.tensor(standardised, dtype=torch.float32).flatten(1)[None]
    with torch.no_grad():
        expected, _ = network.encoder(motion, torch.ones(1, FRAMES, dtype=torch.bool))
    np.testing.assert_allclose(evaluator.features(views[:1]), expected, atol=1e-5)
    # Joints without variation are ignored.
    shifted = views.copy()
    shifted[:, :, 0] += 1e-7
    np.testing.assert_array_equal(evaluator.features(shifted), evaluator.features(views))


def test_features_separate_styles(evaluator):
    assert isinstance(evaluator, EncodesViews)
    features = evaluator.features(views_of("walk", range(100, 140)))
    reference = GenerationReference(evaluator, features)
    walk, run = (
        reference.score_motions(positions_of(style, range(40)), seed=0, repeats=2)
        for style in STYLES
    )
    assert 4 * walk["fid"][0] < run["fid"][0]
    assert walk["precision"][0] > 0.5 > run["precision"][0]


def test_loss_is_the_error_of_visible_joints_plus_the_divergence():
    (first, *_) = tracks = tracks_of(range(2))
    neck = first.skeleton.index("neck")
    confidence = np.where(np.arange(17) == neck, 0.2, np.ones(first.confidence.shape))
    tracks = [replace(track, confidence=confidence) for track in tracks]
    trainee = EvaluatorTrainee(tracks, tracks, replace(SIZE, kl_weight=0.5))
    inputs = []

    def zero(motions, valid, noise):
        inputs.extend((motions.unflatten(2, (17, 2)), valid, noise))
        return torch.zeros_like(motions), torch.full((len(motions),), 3.0)

    loss = trainee.training_loss(zero, np.random.default_rng(0), 8, CPU)
    motions, valid, noise = inputs
    assert noise.shape == (8, SIZE.latent)
    # The fixed root, the occluded neck and padding do not count.
    assert (motions[:, :, [0, neck]] == 0).all()
    assert (motions[~valid] == 0).all()
    expected = (motions**2).sum() / (valid.sum() * 15 * 2) + 0.5 * 3
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    mean, log_variance = torch.randn(2, 6, 5, generator=torch.Generator().manual_seed(0))
    normal = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0))
    torch.testing.assert_close(divergence_from_normal(mean, log_variance), expected.sum(dim=1))


def test_saved_encoder_yields_the_same_features(evaluator, views, tmp_path, run, monkeypatch):
    monkeypatch.setattr(checkpoints, "WEIGHTS", tmp_path)
    with pytest.raises(FileNotFoundError, match="a file or the folder of a training run, got 'f"):
        TrackEvaluator.load("full")
    full, half = tmp_path / "full.safetensors", tmp_path / "half.safetensors"
    evaluator.save(full)
    again = TrackEvaluator.load("full")
    features = again.features(views)
    np.testing.assert_array_equal(features, evaluator.features(views))
    assert (again.fps, again.frames, again.card) == (30.0, FRAMES, evaluator.card)
    assert not any(name.startswith("decoder.") for name in load_checkpoint(full, KIND).tensors)
    evaluator.save(half, half=True)
    error = np.abs(TrackEvaluator.load(half).features(views) - features).max()
    assert 0 < error < 0.01 * features.std()
    assert half.stat().st_size < 0.5 * run.model.stat().st_size
    with pytest.raises(FileNotFoundError, match="run or one of full, half"):
        TrackEvaluator.load("walk")


@pytest.mark.parametrize(
    ("change", "lengths", "message"),
    [
        (lambda v: v[:, :, :14], None, r"views must have shape \(N, L, 17, 2\)"),
        (lambda v: np.zeros((1, 17, 17, 2)), None, "views must have 1 to 16 frames, got 17"),
        (lambda v: v * np.nan, None, "views must be finite"),
        (lambda v: v + 0.3, None, "views must have the pelvis at the origin, .* distance of 0.3 m"),
        (lambda v: v, np.array([3, 3, 3]), r"lengths must have shape \(12\), got \(3,\)"),
        (lambda v: v, np.full(12, 17), "lengths must be integers from 1 to 16"),
        (lambda v: v, np.full(12, 3.0), "lengths must be integers from 1 to 16"),
    ],
)
def test_invalid_views_are_rejected(evaluator, views, change, lengths, message):
    with pytest.raises(ValueError, match=message):
        evaluator.features(change(views), lengths)


@pytest.mark.parametrize(("name", "value"), [("width", 30), ("latent", 0), ("kl_weight", 0)])
def test_invalid_sizes_are_rejected(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .*, got {value}"):
        EvaluatorSettings(**{name: value})

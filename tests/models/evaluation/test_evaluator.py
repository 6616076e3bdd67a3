from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.gaits import make_gait
from probmotion.metrics.filming import film_motions
from probmotion.metrics.generation import EncodesViews, GenerationReference, frechet_distance
from probmotion.models.evaluation.evaluator import KIND, EvaluatorSettings, TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.track_autoencoder import TrackAutoencoder, divergence_from_normal
from probmotion.models.training import checkpoints
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train

FRAMES = 16
STYLES = ("walk", "run")


def gaits(style, numbers):
    return [make_gait(style, number, frames=24) for number in numbers]


def tracks_of(numbers, seed=0):
    clips = [clip for style in STYLES for clip in gaits(style, numbers)]
    return project_clips(clips, views=4, seed=seed, noise=DetectorNoise.none())


def views_of(style, numbers, seed=0):
    positions = np.stack([clip.positions[:FRAMES] for clip in gaits(style, numbers)])
    return film_motions(positions, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a short training, and its result."""
    folder = tmp_path_factory.mktemp("run")
    trainee = EvaluatorTrainee(tracks_of(range(12)), tracks_of(range(12, 16)), SIZE)
    settings = TrainingSettings(
        steps=120, batch=24, learning_rate=3e-3, warmup=10, ema=0.9, checkpoint_every=60
    )
    return folder, train(trainee, settings, folder, progress=False)


SIZE = EvaluatorSettings.tiny(FRAMES)


@pytest.fixture(scope="module")
def evaluator(run):
    return TrackEvaluator.load(run[0])


@pytest.fixture
def views():
    return views_of("walk", range(30, 42))


# ---- features


def test_features_depend_on_a_motion_alone(evaluator, views, monkeypatch):
    many = np.concatenate([views] * 10)
    found = evaluator.features(many)
    assert found.shape == (120, SIZE.latent)
    assert found.dtype == np.float64
    # 56 motions fit a chunk: the same motion stands at other places of several chunks.
    for copy in range(1, 10):
        np.testing.assert_array_equal(found[12 * copy : 12 * copy + 12], found[:12])
    np.testing.assert_array_equal(evaluator.features(views[7:8]), found[7:8])
    assert evaluator.features(views[:0]).shape == (0, SIZE.latent)


def test_what_pads_a_motion_does_not_matter(evaluator, views):
    lengths = np.arange(4, 16)
    padded = views.copy()
    for motion, length in zip(padded, lengths, strict=True):
        motion[length:] = np.nan
    found = evaluator.features(padded, lengths)
    for number, length in enumerate(lengths):
        alone = evaluator.features(views[number : number + 1, :length])
        np.testing.assert_array_equal(found[number : number + 1], alone)
    # But its frames do.
    assert np.abs(found - evaluator.features(views)).min(axis=1).max() > 1e-3


def test_features_are_the_encoders_mean(evaluator, run, views):
    """Computed once more from the checkpoint: the whole autoencoder, one motion, no padding."""
    kept = checkpoints.load_checkpoint(run[1].model, KIND)
    network = TrackAutoencoder(SIZE, 17).eval()
    network.load_state_dict(dict(kept.tensors))
    deviation = np.array(kept.settings["network"]["deviation"])
    mean = np.array(kept.settings["network"]["mean"])
    assert (deviation[0] == 0).all()
    standardised = (views[0] - mean) / np.where(deviation > 0, deviation, np.inf)
    motion = torch.tensor(standardised, dtype=torch.float32).flatten(1)[None]
    with torch.no_grad():
        found, _ = network.encoder(motion, torch.ones(1, FRAMES, dtype=torch.bool))
    np.testing.assert_allclose(evaluator.features(views[:1]), found, atol=1e-5)


def test_a_joint_that_never_varied_is_not_looked_at(evaluator, views):
    moved = views.copy()
    moved[:, :, 0] += 1e-7
    np.testing.assert_array_equal(evaluator.features(moved), evaluator.features(views))


def test_features_tell_styles_apart(evaluator):
    features = {
        (style, half): evaluator.features(views_of(style, range(start, start + 60), start))
        for style in STYLES
        for half, start in (("first", 100), ("second", 200))
    }
    walk = features["walk", "first"]
    same = frechet_distance(walk, features["walk", "second"])
    other = frechet_distance(walk, features["run", "second"])
    assert frechet_distance(walk, walk) < 1e-9
    assert 10 * same < other


def test_generation_is_scored_with_it(evaluator):
    assert isinstance(evaluator, EncodesViews)
    held_out = evaluator.features(views_of("walk", range(100, 140)))
    reference = GenerationReference(evaluator, held_out)
    motions = {
        style: np.stack([clip.positions[:FRAMES] for clip in gaits(style, range(40))])
        for style in STYLES
    }
    walk, run = (reference.score_motions(motions[s], seed=0, repeats=2) for s in STYLES)
    assert walk["fid"][0] < run["fid"][0]
    assert walk["precision"][0] > 0.5 > run["precision"][0]


# ---- learning


def held_out_loss(trainee):
    with torch.no_grad():
        return trainee.validation_loss(trainee.network, torch.device("cpu"))


def test_training_lowers_the_loss_on_held_out_tracks(run):
    before = EvaluatorTrainee(tracks_of(range(12)), tracks_of(range(12, 16)), SIZE)
    first = held_out_loss(before)
    history = run[1].history
    # An autoencoder that says nothing has a loss of about 1.
    assert first > 0.9
    assert history[-1]["validation_loss"] < 0.75 * first
    assert history[-1]["validation_loss"] < history[0]["validation_loss"]


def test_the_divergence_is_that_of_torch():
    mean, log_variance = torch.randn(2, 6, 5, generator=torch.Generator().manual_seed(0))
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(
        normal(mean, (0.5 * log_variance).exp()), normal(0.0, 1.0)
    )
    torch.testing.assert_close(divergence_from_normal(mean, log_variance), expected.sum(dim=1))


def test_the_loss_is_the_error_where_joints_are_seen_plus_the_divergence():
    tracks = tracks_of(range(2))
    confident = np.ones(tracks[0].confidence.shape)
    neck = tracks[0].skeleton.canonical_names.index("neck")
    confident[:, neck] = 0.2
    tracks = [replace(track, confidence=confident) for track in tracks]
    trainee = EvaluatorTrainee(tracks, tracks, replace(SIZE, kl_weight=0.5))
    seen = []

    class Blind(torch.nn.Module):
        def forward(self, motions, valid, noise):
            seen.append((motions, valid, noise))
            return torch.zeros_like(motions), torch.full((len(motions),), 3.0)

    rng = np.random.default_rng(0)
    loss = trainee.training_loss(Blind(), rng, 8, torch.device("cpu"))
    motions, valid, noise = seen[0]
    assert noise.shape == (8, SIZE.latent)
    # The root (never varies) and the neck (never sure) are not there, nor frames past the end.
    motions = motions.unflatten(2, (17, 2))
    assert (motions[:, :, [0, neck]] == 0).all()
    assert (motions[~valid] == 0).all()
    counted = valid.sum() * 15 * 2
    assert float(loss) == pytest.approx(float((motions**2).sum() / counted + 0.5 * 3), rel=1e-5)


def test_weights_and_losses_follow_the_seed():
    tracks = tracks_of(range(2))
    one, same, other = (
        EvaluatorTrainee(tracks, tracks, SIZE, augmentation=Augmentation.none(), seed=seed)
        for seed in (0, 0, 1)
    )
    for a, b in zip(one.network.parameters(), same.network.parameters(), strict=True):
        assert torch.equal(a, b)
    losses = [held_out_loss(trainee) for trainee in (one, same, other)]
    assert losses[0] == losses[1] != losses[2]


def test_another_skeleton_for_validation_is_refused():
    quadrupeds = project_clips([make_gait("quadruped-walk", frames=24)], views=1)
    with pytest.raises(ValueError, match="validation has another skeleton than tracks"):
        EvaluatorTrainee(tracks_of(range(1)), quadrupeds, SIZE)


# ---- files


def test_the_encoder_alone_gives_the_same_features(evaluator, views, tmp_path, run):
    evaluator.save(tmp_path / "whole.safetensors")
    again = TrackEvaluator.load(tmp_path / "whole.safetensors")
    np.testing.assert_array_equal(again.features(views), evaluator.features(views))
    assert again.skeleton == evaluator.skeleton
    assert (again.fps, again.frames) == (30.0, FRAMES)
    assert again.card == evaluator.card
    assert not any(
        name.startswith("decoder.")
        for name in checkpoints.load_checkpoint(tmp_path / "whole.safetensors", KIND).tensors
    )
    evaluator.save(tmp_path / "half.safetensors", half=True)
    near = TrackEvaluator.load(tmp_path / "half.safetensors").features(views)
    assert 0 < np.abs(near - again.features(views)).max() < 0.01 * again.features(views).std()
    size = (tmp_path / "half.safetensors").stat().st_size
    assert size < 0.5 * run[1].model.stat().st_size


def test_an_evaluator_that_comes_with_the_package_is_loaded_by_name(
    evaluator, tmp_path, monkeypatch
):
    monkeypatch.setattr(checkpoints, "WEIGHTS", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"checkpoint walk, .* one of no names"):
        TrackEvaluator.load("walk")
    evaluator.save(tmp_path / "walk2d-evaluator.safetensors", half=True)
    assert TrackEvaluator.load("walk2d-evaluator").frames == FRAMES
    with pytest.raises(FileNotFoundError, match="run or one of walk2d-evaluator"):
        TrackEvaluator.load("walk")


def test_the_small_size_ships_in_a_megabyte():
    weights = sum(p.numel() for p in TrackAutoencoder(SMALL, 14).encoder.parameters())
    assert 2 * weights < 1e6


SMALL = EvaluatorSettings.small()


def test_the_reference_size_is_the_published_codes():
    size = EvaluatorSettings.reference_code()
    assert (size.layers, size.width, size.latent, size.kl_weight) == (6, 256, 256, 1e-5)


# ---- bad input


def test_files_of_other_networks_are_refused(evaluator, run, tmp_path):
    path = tmp_path / "other.safetensors"
    kept = checkpoints.load_checkpoint(run[1].model, KIND)
    missing = {name: tensor for name, tensor in kept.tensors.items() if "mean.bias" not in name}
    save_checkpoint(path, Checkpoint(KIND, kept.settings, missing))
    with pytest.raises(CheckpointError, match="holds weights of another network than its"):
        TrackEvaluator.load(path)
    save_checkpoint(path, Checkpoint("motion-diffusion", kept.settings, kept.tensors))
    with pytest.raises(CheckpointError, match="holds a motion-diffusion, expected a track-evalua"):
        TrackEvaluator.load(path)


def test_views_that_do_not_fit_are_refused(evaluator, views):
    with pytest.raises(ValueError, match=r"views has shape .*, expected \(N, L, 17, 2\)"):
        evaluator.features(views[:, :, :14])
    with pytest.raises(ValueError, match="views has 17 frames, expected 1 to 16"):
        evaluator.features(np.zeros((1, 17, 17, 2)))
    broken = views.copy()
    broken[3, 2, 5] = np.nan
    with pytest.raises(
        ValueError, match="views must be finite, got 2 values that are NaN or infinite"
    ):
        evaluator.features(broken)
    with pytest.raises(ValueError, match=r"lengths must have shape \(12\), got \(3,\)"):
        evaluator.features(views, np.array([3, 3, 3]))
    for lengths in (np.full(12, 17), np.full(12, 0), np.full(12, 3.0)):
        with pytest.raises(ValueError, match=r"lengths must be integers from 1 to 16, got \[.*\]"):
            evaluator.features(views, lengths)


def test_views_that_are_not_centred_are_refused(evaluator, views):
    with pytest.raises(ValueError, match=r"views has pelvis up to 0.3 m off the origin, expected"):
        evaluator.features(views + 0.3)


def test_sizes_out_of_range_are_refused():
    with pytest.raises(ValueError, match="width must be an even multiple of heads, 4, got 30"):
        EvaluatorSettings(width=30)
    with pytest.raises(ValueError, match="latent must be an integer of at least 1, got 0"):
        EvaluatorSettings(latent=0)
    with pytest.raises(ValueError, match="kl_weight must be a finite number above 0, got 0"):
        EvaluatorSettings(kl_weight=0)


def test_no_cuda_is_said(evaluator, run):
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(ValueError, match="device is 'cuda', but this machine has no CUDA"):
        TrackEvaluator.load(run[0], device="cuda")

"""The prior on a tiny network with fresh weights: motions, places, files, samplers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, Skeleton
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.latent.reduced_latent import ReducedLatent
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.models.vae.model import KIND, MotionVAEModel, description_of
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.observed_views import picture_of
from probmotion.models.vae.pose_network import PoseGuesses
from probmotion.models.vae.rigid_paths import RigidPath
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.posteriors.protocols import (
    DenoisesCoordinates,
    HasInferenceNetwork,
    HasLogDensity,
    MotionPrior,
    Samplable,
)
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers import (
    NUTS,
    Ensemble,
    MetropolisHastings,
    MultiViewAncestral,
    ScoreDistillation,
)

LEGS = Skeleton(
    [
        "pelvis",
        "left_hip",
        "left_knee",
        "left_ankle",
        "right_hip",
        "right_knee",
        "right_ankle",
        "neck",
        "head_top",
    ],
    [-1, 0, 1, 2, 0, 4, 5, 0, 7],
)
REST = np.array(
    [
        [0, 0, 0],
        [0.1, 0, 0],
        [0, -0.4, 0.02],
        [0, -0.4, -0.02],
        [-0.1, 0, 0],
        [0, -0.4, 0.02],
        [0, -0.4, -0.02],
        [0, 0.5, 0],
        [0, 0.25, 0.02],
    ]
)
BODY = ArticulatedBody(LEGS, REST)
TINY = replace(MotionVAESettings.tiny(), frames=6, latent=3)


def fresh(size=TINY, gain=40.0, **options):
    """A prior with fresh weights whose last layer makes bodies move."""
    model = MotionVAEModel.of(size, BODY)
    with torch.no_grad():
        model.vae.bone_decoder.leave.weight.mul_(gain)
    card = {"network": description_of(size, BODY, 20.0)}
    return MotionVAE(model.vae, model.pose, size, BODY, 20.0, card=card, **options)


@pytest.fixture(scope="module")
def prior():
    return fresh()


def codes(n=4, seed=1, dim=TINY.latent):
    return np.random.default_rng(seed).standard_normal((n, dim))


def some_path(frames=TINY.frames, seed=5):
    rng = np.random.default_rng(seed)
    vectors = np.cumsum(0.1 * rng.standard_normal((frames, 3)), axis=0)
    return RigidPath(vector_to_matrix(vectors), 0.3 * rng.standard_normal((frames, 3)))


# --- the prior


def test_it_is_what_samplers_ask_for(prior):
    for protocol in (MotionPrior, Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(prior, protocol)
        assert isinstance(ReducedLatent(prior, 2), protocol)
    assert isinstance(prior, HasInferenceNetwork)
    assert (prior.frames, prior.fps, prior.dim, prior.skeleton) == (6, 20.0, 3, LEGS)


def test_the_rest_pose_stands_upright_on_the_floor_and_looks_ahead():
    still = fresh(gain=0.0).motion(np.ones(3))
    np.testing.assert_allclose(still[:, 3], [[0.1, 0.0, 0.0]] * 6, atol=1e-12)
    np.testing.assert_allclose(still[:, 0], [[0.0, 0.8, 0.0]] * 6, atol=1e-12)
    np.testing.assert_allclose(still[:, 8], [[0.0, 1.55, 0.02]] * 6, atol=1e-12)


def test_the_motion_is_the_decoded_turns_kinematics(prior):
    z = codes()
    with torch.no_grad():
        turns = prior.model.vae.decode(torch.as_tensor(z, dtype=torch.float32)).numpy()
    assert turns.std() > 0.05
    np.testing.assert_allclose(prior.turns(z), turns, atol=1e-5)
    path = prior.rigid
    want = BODY.positions(prior.turns(z), path.rotations, path.translations)
    np.testing.assert_allclose(prior.motion(z), want, atol=1e-12)
    lengths = np.linalg.norm(want[..., 1:, :] - want[..., LEGS.parents[1:], :], axis=-1)
    np.testing.assert_allclose(
        lengths, np.broadcast_to(np.linalg.norm(REST[1:], axis=-1), lengths.shape), atol=1e-12
    )


def test_another_path_moves_all_joints_as_one_body(prior):
    path, z = some_path(), codes()
    still = RigidPath(np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3)))
    about = prior.placed(still).motion(z)
    moved = np.einsum("lik,bljk->blji", path.rotations, about) + path.translations[:, None]
    np.testing.assert_allclose(prior.placed(path).motion(z), moved, atol=1e-12)


def test_longer_bones_are_longer_by_their_factor(prior):
    longer = prior.placed(prior.rigid, np.full(BODY.n_groups, math.log(1.5)))
    root = prior.rigid.translations[:, None]
    np.testing.assert_allclose(
        longer.motion(codes()) - root, 1.5 * (prior.motion(codes()) - root), atol=1e-12
    )


@pytest.mark.parametrize("shape", [(3,), (2, 3), (2, 5, 3), (0, 3)])
def test_every_batch_shape_and_library_gives_the_same_motion(prior, shape):
    z = np.random.default_rng(0).standard_normal(shape)
    found = prior.motion(z)
    assert found.shape == (*shape[:-1], 6, 9, 3)
    assert found.dtype == np.float64
    other = prior.motion(torch.as_tensor(z))
    assert other.dtype == torch.float64
    np.testing.assert_allclose(other.numpy(), found, atol=1e-12)
    single = prior.motion(z.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, found, atol=1e-5)


def test_torch_differentiates_the_motion(prior):
    z = torch.as_tensor(codes(2)).requires_grad_()
    assert torch.autograd.gradcheck(prior.placed(some_path()).motion, z)
    assert not any(weights.requires_grad for weights in prior.model.parameters())


def test_the_density_is_the_standard_normal_s(prior):
    z = codes()
    want = stats.norm.logpdf(z).sum(axis=-1)
    np.testing.assert_allclose(prior.log_density(z), want, rtol=1e-12)
    np.testing.assert_allclose(prior.log_density(torch.as_tensor(z)).numpy(), want, rtol=1e-12)
    np.testing.assert_allclose(prior.denoise_coordinates(z, 0.25), 0.5 * z)


def test_draws_do_not_depend_on_how_many_there_are(prior, monkeypatch):
    """Rounding depends on the shape of a product, so that the shape must always be the same."""
    shapes, decode = [], prior.model.vae.decode

    def spy(latents):
        shapes.append(tuple(latents.shape))
        return decode(latents)

    monkeypatch.setattr(prior.model.vae, "decode", spy)
    many = prior.sample(np.random.default_rng(3), 70)
    np.testing.assert_array_equal(many[:3], prior.sample(np.random.default_rng(3), 3))
    assert shapes == [(64, 3)] * 3
    np.testing.assert_allclose(
        many, prior.motion(prior.initial(np.random.default_rng(3), 70)), atol=1e-5
    )
    assert many.dtype == np.float64


# --- files


@pytest.mark.parametrize(("half", "tolerance"), [(False, 1e-12), (True, 5e-3)])
def test_a_file_holds_the_prior(prior, tmp_path, half, tolerance):
    prior.save(tmp_path / "model.safetensors", half=half)
    for source in (tmp_path, tmp_path / "model.safetensors"):
        other = MotionVAE.load(source, rigid=some_path())
        np.testing.assert_allclose(
            other.motion(codes()), prior.placed(some_path()).motion(codes()), atol=tolerance
        )
    assert (other.skeleton, other.fps, other.settings) == (LEGS, 20.0, TINY)
    names = prior.model.state_dict()
    assert {name.partition(".")[0] for name in names} == {"vae", "pose"}


def test_other_files_are_refused(prior, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no checkpoint nothing-like-it"):
        MotionVAE.load("nothing-like-it")
    save_checkpoint(tmp_path / "a.safetensors", Checkpoint("other", {}, {}))
    with pytest.raises(CheckpointError, match="holds a other, expected a motion-vae"):
        MotionVAE.load(tmp_path / "a.safetensors")
    save_checkpoint(tmp_path / "b.safetensors", Checkpoint(KIND, {"network": {}}, {}))
    with pytest.raises(CheckpointError, match="has settings that are no motion VAE's"):
        MotionVAE.load(tmp_path / "b.safetensors")
    anonymous = MotionVAE(prior.model.vae, prior.model.pose, TINY, BODY, 20.0)
    with pytest.raises(ValueError, match="the prior has no card, expected one that was trained"):
        anonymous.save(tmp_path / "c.safetensors")


# --- where the pose network sees the body


class Knows(torch.nn.Module):
    """A pose network that has been told; its hypothesis 2 is right, the others are turned."""

    def __init__(self, rotations, turns, log_lengths):
        super().__init__()
        quarters = vector_to_matrix(np.pi / 2 * (np.arange(4) - 2)[:, None] * np.eye(3)[1])
        self.told = rotations @ quarters[:, None], turns, log_lengths

    def forward(self, keypoints, confidence, rest):
        rotation, turns, lengths = (
            torch.as_tensor(part, dtype=torch.float32)[None] for part in self.told
        )
        frames = keypoints.shape[1]
        np.testing.assert_allclose(rest.numpy(), BODY.rest_positions, atol=1e-6)
        return PoseGuesses(
            rotation,
            torch.zeros(1, 4, frames, 2),
            turns.expand(1, 4, *turns.shape[1:]),
            lengths.expand(1, 4, -1),
        )


def filmed(prior, camera, path, z, log_lengths=None, **options):
    """Evidence almost without noise, and the prior with a pose network that knows the body."""
    placed = prior.placed(path, log_lengths)
    motion = Motion(placed.motion(z), LEGS, 20.0)
    seen = Keypoints2D.observe(motion, camera, 1e-4, seed=0, **options)
    # A frame with y up and z towards the camera.
    relative = np.diag([1.0, -1.0, -1.0]) @ camera.rotation[0] @ path.rotations
    knows = Knows(relative, prior.turns(z), placed.log_lengths)
    return seen, MotionVAE(prior.model.vae, knows, TINY, BODY, 20.0)


def test_an_orthographic_camera_shows_where_the_body_is(prior):
    camera = Cameras.around(np.array([2.0]), np.array([0.4]))
    lengths = np.linspace(-0.1, 0.1, BODY.n_groups)
    seen, other = filmed(prior, camera, some_path(), codes()[0], lengths)
    placed = other.placed_by(seen)
    np.testing.assert_allclose(placed.rigid.rotations, some_path().rotations, atol=1e-5)
    np.testing.assert_allclose(placed.log_lengths, lengths, atol=1e-6)
    # The depth of the root is not seen: that of the origin is taken.
    away = camera.rotation[0, 2]
    moved = placed.rigid.translations - some_path().translations
    np.testing.assert_allclose(placed.rigid.translations @ away, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(moved, away), 0.0, atol=1e-3)
    np.testing.assert_allclose(camera.project(placed.motion(codes()[0])), seen.keypoints, atol=1e-3)


def test_a_perspective_camera_shows_how_far_away_the_body_is(prior):
    camera = Cameras(
        np.eye(3)[None] * np.array([1.0, -1.0, -1.0]),
        np.array([[0.0, 0.0, 9.0]]),
        np.array([800.0]),
        np.array([[640.0, 360.0]]),
        orthographic=False,
    )
    path = RigidPath(some_path().rotations, np.tile([0.0, 0.0, 4.0], (6, 1)))
    seen, other = filmed(prior, camera, path, codes()[1])
    placed = other.placed_by(seen)
    np.testing.assert_allclose(placed.rigid.translations, path.translations, atol=2e-3)
    np.testing.assert_allclose(placed.rigid.rotations, path.rotations, atol=1e-5)


def test_the_picture_is_centred_on_the_root_and_interpolated_where_it_is_hidden(prior):
    camera = Cameras.around(np.array([0.3]), np.array([0.1]))
    motion = Motion(prior.placed(some_path()).motion(codes()[0]), LEGS, 20.0)
    hidden = np.zeros((6, 9), dtype=bool)
    hidden[2, 0] = hidden[3, 5] = True
    seen = Keypoints2D.observe(motion, camera, 1e-4, seed=0, hidden=hidden)
    picture = picture_of(seen, LEGS)
    whole = camera.project(motion.positions)[0]
    np.testing.assert_allclose(picture.root[2], (whole[1, 0] + whole[3, 0]) / 2, atol=1e-3)
    np.testing.assert_array_equal(picture.confidence, 1.0 - hidden)
    about = np.where(hidden[..., None], 0.0, whole - picture.root[:, None])
    np.testing.assert_allclose(picture.keypoints, about, atol=1e-3)


def evidence(prior, frames=6, views=1, hidden=None, fps=20.0):
    motion = Motion(np.resize(prior.motion(codes()[0]), (frames, 9, 3)), LEGS, fps)
    return Keypoints2D.observe(motion, Cameras.ring(views), 0.05, seed=1, hidden=hidden)


def whole_frame():
    hidden = np.zeros((6, 9), dtype=bool)
    hidden[4] = True
    return hidden


def no_root():
    hidden = np.zeros((6, 9), dtype=bool)
    hidden[:, 0] = True
    return hidden


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"frames": 8}, "likelihood has 8 frames, expected the prior's 6"),
        ({"fps": 30.0}, "likelihood is at 30 frames per second, expected the prior's 20"),
        ({"views": 2}, "likelihood has 2 views, expected one, as the network has learnt"),
        ({"hidden": whole_frame()}, "likelihood shows no joint in frame 4, expected some in every"),
        ({"hidden": no_root()}, "likelihood never shows the pelvis, expected it in a frame at"),
    ],
)
def test_evidence_that_cannot_be_seen_is_refused(prior, options, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        prior.placed_by(evidence(prior, **options))


def test_a_body_that_no_one_has_placed_has_no_evidence(prior):
    seen = evidence(prior)
    for unplaced in (prior, fresh(log_lengths=np.zeros(BODY.n_groups)), ReducedLatent(prior, 2)):
        with pytest.raises(ValueError, match=r"^prior has a body that no one has placed: .*_by\("):
            MotionPosterior(unplaced, seen)
        assert MotionPosterior(unplaced).likelihood is None
    known = prior.placed(prior.rigid)
    for placed in (prior.placed_by(seen), fresh(rigid=some_path()), known, ReducedLatent(known, 2)):
        assert MotionPosterior(placed, seen).likelihood is seen


def test_wrong_parts_are_refused(prior):
    joints = Joints3D(np.zeros((6, 9, 3)), 0.1)
    with pytest.raises(ValueError, match="likelihood must be Keypoints2D, got Joints3D"):
        prior.placed_by(joints)
    with pytest.raises(ValueError, match="rigid has 5 frames, expected 6"):
        prior.placed(some_path(frames=5))
    with pytest.raises(ValueError, match=r"log_lengths has shape \(1,\), expected"):
        prior.placed(some_path(), np.zeros(1))
    with pytest.raises(ValueError, match="rotations is off orthonormal matrices"):
        RigidPath(2 * np.eye(3)[None], np.zeros((1, 3)))
    with pytest.raises(TypeError, match="theta is a list, expected NumPy's or torch's"):
        prior.motion([0.0, 0.0, 0.0])


# --- samplers


def test_mas_needs_a_denoiser_and_says_who_would_do(prior):
    with pytest.raises(
        UnsupportedPosterior,
        match=r"^mas needs a prior with Denoises2D, which MotionVAE is not; .*nuts.* would do$",
    ) as refused:
        MultiViewAncestral().sample(MotionPosterior(prior), progress=False)
    assert refused.value.word == "Denoises2D"
    assert "; probmotion.models.diffusion.projected_denoiser.denoiser_of makes" in str(
        refused.value
    )
    with pytest.raises(UnsupportedPosterior, match=r"ReducedLatent is not; .*denoiser_of makes"):
        MultiViewAncestral().sample(MotionPosterior(ReducedLatent(prior, 2)), progress=False)


SAMPLERS = {
    "nuts": NUTS(warmup=4, max_tree_depth=2, candidates=4),
    "mh": MetropolisHastings(warmup=20, thin=2, candidates=8),
    "ensemble": Ensemble(walkers=8, warmup=20, thin=2, candidates=16),
    "sds": ScoreDistillation(iterations=5),
}


@pytest.mark.parametrize(
    ("name", "k"),
    [("nuts", None), ("mh", None), ("mh", 2), ("ensemble", 2), ("sds", None), ("sds", 2)],
)
def test_samplers_run_in_z(prior, name, k):
    likelihood = evidence(prior)
    placed = prior.placed_by(likelihood)
    posterior = MotionPosterior(placed if k is None else ReducedLatent(placed, k), likelihood)
    assert name in suited(posterior)
    draws = SAMPLERS[name].sample(posterior, draws=4, chains=2, seed=0, progress=False)
    assert draws.positions.shape == (2, 4, 6, 9, 3)
    assert np.isfinite(draws.positions).all()


# --- fewer dimensions


class Stretches:
    """X = A z: directions of known gains."""

    skeleton, frames, fps, dim = LEGS, 2, 20.0, 5
    gains = np.array([0.3, 3.0, 0.2, 2.0, 0.1])

    def __init__(self):
        rng = np.random.default_rng(0)
        self.turn = np.linalg.qr(rng.standard_normal((5, 5)))[0]
        self.basis = np.linalg.qr(rng.standard_normal((54, 5)))[0]

    def motion(self, theta):
        matrix = self.turn @ (self.gains[:, None] * self.basis.T)
        if isinstance(theta, torch.Tensor):
            matrix = torch.as_tensor(matrix, dtype=theta.dtype)
        return (theta @ matrix).reshape(*theta.shape[:-1], 2, 9, 3)


def test_the_directions_are_those_of_the_greatest_change():
    prior = Stretches()
    reduced = ReducedLatent(prior, 2)
    want = prior.turn[:, [1, 3]]
    # Their span, to the error of 512 random pull-backs.
    overlap = np.linalg.svd(want.T @ reduced.directions)[1]
    assert overlap.min() > 0.99
    np.testing.assert_allclose(reduced.directions.T @ reduced.directions, np.eye(2), atol=1e-12)
    assert reduced.kept == pytest.approx(13 / 13.14, abs=0.005)
    theta = codes(dim=2)
    np.testing.assert_allclose(
        reduced.motion(theta), prior.motion(theta @ reduced.directions.T), atol=1e-12
    )
    np.testing.assert_array_equal(reduced.directions, ReducedLatent(prior, 2).directions)


def test_all_directions_lose_nothing_and_more_there_are_not(prior):
    reduced = ReducedLatent(prior, 3)
    assert reduced.kept == pytest.approx(1.0)
    theta = codes()
    np.testing.assert_allclose(reduced.motion(theta), prior.motion(reduced.latent(theta)))
    np.testing.assert_allclose(reduced.log_density(theta), prior.log_density(theta))
    assert 0.3 < ReducedLatent(prior, 1).kept < ReducedLatent(prior, 2).kept < 1
    with pytest.raises(ValueError, match="k must be at most the prior's 3 dimensions, got 4"):
        ReducedLatent(prior, 4)

"""Motion VAE prior with random weights: motions, placement, files and samplers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, Skeleton
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.latent.code_mixture import CodeMixture
from probmotion.models.latent.reduced_latent import ReducedLatent
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.network import KIND, MotionVAEModel, description_of
from probmotion.models.vae.observed_views import observed_view
from probmotion.models.vae.pose_network import PoseHypotheses
from probmotion.models.vae.rigid_paths import RigidPath
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.posteriors.protocols import DenoisesCoordinates, HasInferenceNetwork, HasLogDensity
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers import Ensemble, MetropolisHastings, MultiViewAncestral, ScoreDistillation

LEGS = Skeleton(
    ["pelvis", "left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle",
     "neck", "head_top"],
    [-1, 0, 1, 2, 0, 4, 5, 0, 7],
)  # fmt: skip
REST = np.array(
    [[0, 0, 0], [0.1, 0, 0], [0, -0.4, 0.02], [0, -0.4, -0.02], [-0.1, 0, 0], [0, -0.4, 0.02],
     [0, -0.4, -0.02], [0, 0.5, 0], [0, 0.25, 0.02]]
)  # fmt: skip
BODY = ArticulatedBody(LEGS, REST)
TINY = replace(MotionVAESettings.tiny(), frames=6, latent=3)


def build(size=TINY, gain=40.0, **options):
    """Return a prior with random weights and large motions."""
    model = MotionVAEModel.of(size, BODY)
    with torch.no_grad():
        model.vae.bone_decoder.leave.weight.mul_(gain)
    card = {"network": description_of(size, BODY, 20.0)}
    return MotionVAE(model.vae, model.pose, size, BODY, 20.0, card=card, **options)


@pytest.fixture(scope="module")
def prior():
    return build()


def codes(n=4, seed=1, dim=TINY.latent):
    return np.random.default_rng(seed).standard_normal((n, dim))


def make_path(frames=TINY.frames, seed=5):
    rng = np.random.default_rng(seed)
    vectors = np.cumsum(0.1 * rng.standard_normal((frames, 3)), axis=0)
    return RigidPath(vector_to_matrix(vectors), 0.3 * rng.standard_normal((frames, 3)))


def test_rest_pose_is_upright_on_the_floor():
    static = build(gain=0.0).motion(np.ones(3))
    np.testing.assert_allclose(static[:, 3], [[0.1, 0.0, 0.0]] * 6, atol=1e-12)
    np.testing.assert_allclose(static[:, 0], [[0.0, 0.8, 0.0]] * 6, atol=1e-12)
    np.testing.assert_allclose(static[:, 8], [[0.0, 1.55, 0.02]] * 6, atol=1e-12)


def test_motion_is_the_kinematics_of_decoded_rotations(prior):
    z, path = codes(), prior.rigid
    turns = prior.model.vae.decode(torch.as_tensor(z, dtype=torch.float32)).numpy()
    assert turns.std() > 0.05
    np.testing.assert_allclose(prior.turns(z), turns, atol=1e-5)
    expected = BODY.positions(prior.turns(z), path.rotations, path.translations)
    np.testing.assert_allclose(prior.motion(z), expected, atol=1e-12)


def test_rigid_path_and_lengths_transform_the_body(prior):
    path, z = make_path(), codes()
    static = RigidPath(np.tile(np.eye(3), (6, 1, 1)), np.zeros((6, 3)))
    centred = prior.placed(static).motion(z)
    transformed = np.einsum("lik,bljk->blji", path.rotations, centred) + path.translations[:, None]
    np.testing.assert_allclose(prior.placed(path).motion(z), transformed, atol=1e-12)
    longer = prior.placed(static, np.full(BODY.n_groups, math.log(1.5)))
    np.testing.assert_allclose(longer.motion(z), 1.5 * centred, atol=1e-12)


def test_motion_is_differentiable(prior):
    z = torch.as_tensor(codes(2)).requires_grad_()
    assert torch.autograd.gradcheck(prior.placed(make_path()).motion, z)
    assert not any(weights.requires_grad for weights in prior.model.parameters())


def test_draws_do_not_depend_on_the_batch(prior):
    draws = prior.sample(np.random.default_rng(3), 70)
    np.testing.assert_array_equal(draws[:3], prior.sample(np.random.default_rng(3), 3))
    theta = prior.initial(np.random.default_rng(3), 70)
    np.testing.assert_allclose(draws, prior.motion(theta), atol=1e-5)
    assert draws.dtype == np.float64


def mixture():
    rng = np.random.default_rng(4)
    factors = np.tril(0.3 * rng.standard_normal((2, 3, 3))) + 0.5 * np.eye(3)
    return CodeMixture(np.array([0.3, 0.7]), rng.standard_normal((2, 3)), factors)


@pytest.mark.parametrize(("half", "tolerance"), [(False, 1e-12), (True, 5e-3)])
def test_checkpoint_round_trip(tmp_path, half, tolerance):
    prior = build(codes=mixture())
    prior.save(tmp_path / "model.safetensors", half=half)
    other = MotionVAE.load(tmp_path, rigid=make_path())
    expected = prior.placed(make_path()).motion(codes())
    np.testing.assert_allclose(other.motion(codes()), expected, atol=tolerance)
    assert (other.skeleton, other.fps, other.settings) == (LEGS, 20.0, TINY)
    np.testing.assert_allclose(other.codes.factors, prior.codes.factors, atol=tolerance)
    density = prior.placed(make_path()).log_density(codes())
    np.testing.assert_allclose(other.log_density(codes()), density, atol=40 * tolerance)


def test_codes_follow_the_mixture():
    drawn = build(codes=mixture()).initial(np.random.default_rng(0), 5)
    np.testing.assert_array_equal(drawn, mixture().draw(np.random.default_rng(0), 5))
    with pytest.raises(ValueError, match=r"codes.means must have shape"):
        build(codes=CodeMixture.standard(2))


def test_checkpoints_without_a_mixture_have_the_standard_normal_and_say_so(prior, tmp_path):
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, Checkpoint(KIND, prior.card, prior.model.state_dict()))
    expected = -0.5 * (codes() ** 2 + math.log(2 * math.pi)).sum(axis=1)
    with pytest.warns(UserWarning, match=r"no mixture of codes.*probmotion train motion-vae"):
        loaded = MotionVAE.load(path)
    np.testing.assert_allclose(loaded.log_density(codes()), expected)
    np.testing.assert_allclose(MotionVAE.load(path, codes=None).log_density(codes()), expected)


class FixedPoses(torch.nn.Module):
    """Pose network with fixed outputs: hypothesis 2 is true, the others are rotated."""

    def __init__(self, rotations, turns, log_lengths):
        super().__init__()
        quarters = vector_to_matrix(np.pi / 2 * (np.arange(4) - 2)[:, None] * np.eye(3)[1])
        self.poses = rotations @ quarters[:, None], turns, log_lengths

    def forward(self, keypoints, confidence, rest):
        np.testing.assert_allclose(rest.numpy(), BODY.rest_positions, atol=1e-6)
        rotation, turns, lengths = (
            torch.as_tensor(part, dtype=torch.float32)[None] for part in self.poses
        )
        zero = torch.zeros(1, 4, keypoints.shape[1], 2)
        turns, lengths = turns.expand(1, 4, *turns.shape[1:]), lengths.expand(1, 4, -1)
        return PoseHypotheses(rotation, zero, turns, lengths)


def observed_body(prior, camera, path, z, log_lengths=None, **options):
    """Return observations almost without noise, and the prior with a true pose network."""
    placed = prior.placed(path, log_lengths)
    motion = Motion(placed.motion(z), LEGS, 20.0)
    seen = Keypoints2D.observe(motion, camera, 1e-4, seed=0, **options)
    # The camera axes have y up and z towards the camera.
    relative = np.diag([1.0, -1.0, -1.0]) @ camera.rotation[0] @ path.rotations
    fixed = FixedPoses(relative, prior.turns(z), placed.log_lengths)
    return seen, MotionVAE(prior.model.vae, fixed, TINY, BODY, 20.0)


def test_placement_by_an_orthographic_camera(prior):
    camera = Cameras.around(np.array([2.0]), np.array([0.4]))
    lengths = np.linspace(-0.1, 0.1, BODY.n_groups)
    seen, other = observed_body(prior, camera, make_path(), codes()[0], lengths)
    placed = other.placed_by(seen)
    np.testing.assert_allclose(placed.rigid.rotations, make_path().rotations, atol=1e-5)
    np.testing.assert_allclose(placed.log_lengths, lengths, atol=1e-6)
    # The root depth is not observed and is that of the origin.
    axis = camera.rotation[0, 2]
    transformed = placed.rigid.translations - make_path().translations
    np.testing.assert_allclose(placed.rigid.translations @ axis, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(transformed, axis), 0.0, atol=1e-3)
    np.testing.assert_allclose(camera.project(placed.motion(codes()[0])), seen.keypoints, atol=1e-3)


def test_placement_by_a_perspective_camera_recovers_the_distance(prior):
    rotation, centre = np.diag([1.0, -1.0, -1.0])[None], np.array([[640.0, 360.0]])
    camera = Cameras(rotation, np.array([[0, 0, 9.0]]), np.array([800.0]), centre, False)
    path = RigidPath(make_path().rotations, np.tile([0.0, 0.0, 4.0], (6, 1)))
    seen, other = observed_body(prior, camera, path, codes()[1])
    placed = other.placed_by(seen)
    np.testing.assert_allclose(placed.rigid.translations, path.translations, atol=2e-3)
    np.testing.assert_allclose(placed.rigid.rotations, path.rotations, atol=1e-5)


def test_view_is_centred_on_the_interpolated_root(prior):
    camera = Cameras.around(np.array([0.3]), np.array([0.1]))
    motion = Motion(prior.placed(make_path()).motion(codes()[0]), LEGS, 20.0)
    hidden = occluded([2, 3], [0, 5])
    seen = Keypoints2D.observe(motion, camera, 1e-4, seed=0, hidden=hidden)
    view = observed_view(seen, LEGS)
    projected = camera.project(motion.positions)[0]
    np.testing.assert_allclose(view.root[2], (projected[1, 0] + projected[3, 0]) / 2, atol=1e-3)
    np.testing.assert_array_equal(view.confidence, 1.0 - hidden)
    centred = np.where(hidden[..., None], 0.0, projected - view.root[:, None])
    np.testing.assert_allclose(view.keypoints, centred, atol=1e-3)


def observations(prior, frames=6, views=1, hidden=None, fps=20.0):
    motion = Motion(np.resize(prior.motion(codes()[0]), (frames, 9, 3)), LEGS, fps)
    return Keypoints2D.observe(motion, Cameras.ring(views), 0.05, seed=1, hidden=hidden)


def occluded(*part):
    hidden = np.zeros((6, 9), dtype=bool)
    hidden[part] = True
    return hidden


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"frames": 8}, "likelihood must have the prior's 6 frames, got 8"),
        ({"fps": 30.0}, "likelihood must have the prior's 20 frames per second, got 30"),
        ({"views": 2}, "likelihood must have one view, got 2"),
        ({"hidden": occluded(4)}, "likelihood must have a visible joint per frame, got none in"),
        ({"hidden": occluded(slice(6), 0)}, "likelihood must show the root pelvis"),
    ],
)
def test_unsuitable_observations_are_rejected(prior, options, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        prior.placed_by(observations(prior, **options))


def test_observations_require_a_rigid_path(prior):
    seen, placed_prior = observations(prior), prior.placed(prior.rigid)
    for unplaced in (prior, build(log_lengths=np.zeros(BODY.n_groups)), ReducedLatent(prior, 2)):
        with pytest.raises(ValueError, match=r"^prior must have a rigid path for obse.*_by\("):
            MotionPosterior(unplaced, seen)
        assert MotionPosterior(unplaced).likelihood is None
    for placed in (build(rigid=make_path()), placed_prior, ReducedLatent(placed_prior, 2)):
        assert MotionPosterior(placed, seen).likelihood is seen


def test_invalid_arguments_are_rejected(prior, tmp_path):
    unrecorded = MotionVAE(prior.model.vae, prior.model.pose, TINY, BODY, 20.0)
    for call, message in (
        (lambda: prior.placed_by(Joints3D(np.zeros((6, 9, 3)), 0.1)), "must be Keypoints2D, got J"),
        (lambda: prior.placed(make_path(frames=5)), "rigid must have the prior's 6 frames, got 5"),
        (lambda: prior.placed(make_path(), np.zeros(1)), "log_lengths must have shape"),
        (lambda: RigidPath(2 * np.eye(3)[None], np.zeros((1, 3))), "rotations must be orthonormal"),
        (lambda: unrecorded.save(tmp_path), "prior must have a training record"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    save_checkpoint(tmp_path / "b.safetensors", Checkpoint(KIND, {"network": {}}, {}))
    with pytest.raises(CheckpointError, match="must contain valid motion-vae settings"):
        MotionVAE.load(tmp_path / "b.safetensors")


def test_mas_error_names_alternatives(prior):
    for given in (prior, ReducedLatent(prior, 2)):
        with pytest.raises(UnsupportedPosterior, match="denoiser_of trains") as refused:
            MultiViewAncestral().sample(MotionPosterior(given), progress=False)
        assert refused.value.word == "Denoises2D"
        assert "nuts" in str(refused.value)


@pytest.mark.parametrize(
    ("name", "sampler", "k"),
    [
        ("mh", MetropolisHastings(warmup=20, thin=2, candidates=8), 3),
        ("ensemble", Ensemble(walkers=8, warmup=20, thin=2, candidates=16), 2),
        ("sds", ScoreDistillation(iterations=5), 3),
    ],
)
def test_samplers_run_on_latents(prior, name, sampler, k):
    likelihood = observations(prior)
    placed = prior.placed_by(likelihood)
    for protocol in (HasInferenceNetwork, HasLogDensity, DenoisesCoordinates):
        assert isinstance(placed, protocol)
    posterior = MotionPosterior(placed if k == 3 else ReducedLatent(placed, k), likelihood)
    assert name in suited(posterior)
    draws = sampler.sample(posterior, draws=4, chains=2, seed=0, progress=False)
    assert draws.positions.shape == (2, 4, 6, 9, 3)
    assert np.isfinite(draws.positions).all()


class LinearMotions:
    """Linear prior X = A z with known gains."""

    skeleton, frames, fps, dim = LEGS, 2, 20.0, 5
    gains = np.array([0.3, 3.0, 0.2, 2.0, 0.1])

    def __init__(self):
        rng = np.random.default_rng(0)
        self.rotation = np.linalg.qr(rng.standard_normal((5, 5)))[0]
        self.basis = np.linalg.qr(rng.standard_normal((54, 5)))[0]
        self.codes = CodeMixture.standard(5)

    def initial(self, rng, n):
        return self.codes.draw(rng, n)

    def motion(self, theta):
        matrix = self.rotation @ (self.gains[:, None] * self.basis.T)
        if isinstance(theta, torch.Tensor):
            matrix = torch.as_tensor(matrix, dtype=theta.dtype)
        return (theta @ matrix).reshape(*theta.shape[:-1], 2, 9, 3)


def test_reduced_directions_span_the_largest_variation():
    """The estimate uses 512 random pull-backs."""
    prior = LinearMotions()
    reduced = ReducedLatent(prior, 2)
    directions, theta = reduced.directions, codes(dim=2)
    assert np.linalg.svd(prior.rotation[:, [1, 3]].T @ directions)[1].min() > 0.99
    np.testing.assert_allclose(directions.T @ directions, np.eye(2), atol=1e-12)
    assert reduced.explained == pytest.approx(13 / 13.14, abs=0.005)
    expected = prior.motion(theta @ directions.T)
    np.testing.assert_allclose(reduced.motion(theta), expected, atol=1e-12)
    np.testing.assert_array_equal(directions, ReducedLatent(prior, 2).directions)


def test_all_directions_reproduce_the_prior(prior):
    reduced = ReducedLatent(prior, 3)
    assert reduced.explained == pytest.approx(1.0)
    theta = codes()
    np.testing.assert_allclose(reduced.motion(theta), prior.motion(reduced.latent(theta)))
    density = prior.log_density(reduced.latent(theta))
    np.testing.assert_allclose(reduced.log_density(theta), density)
    assert 0.3 < ReducedLatent(prior, 1).explained < ReducedLatent(prior, 2).explained < 1
    with pytest.raises(ValueError, match="k must be at most the prior's 3 dimensions, got 4"):
        ReducedLatent(prior, 4)

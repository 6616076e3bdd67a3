"""Training of the motion VAE from 2D tracks: view selection, losses and input checks."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import seeds
from probmotion.data.projections import DetectorNoise, Filming
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.tracks.learning import film_clips
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.training.trainer import train
from probmotion.models.vae.losses import hypothesis_losses, weighted_sum
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee, PoseTrainee, usual_motion_vae_training
from probmotion.models.vae.view_hypotheses import evaluate_hypotheses
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton

CPU = torch.device("cpu")
PERSON = Skeleton.preset("person14")
ANKLES = [PERSON.index("left_ankle"), PERSON.index("right_ankle")]
TINY = MotionVAESettings.tiny()


def walks(n, seed=0):
    return make_gaits(n, styles={"walk": 1.0}, frames=90, seed=seed)


def filmed(clips, views=8):
    return film_clips(clips, PERSON, 10.0, views=views, noise=DetectorNoise(share=0.0)).tracks


@pytest.fixture(scope="module")
def tracks():
    return filmed(walks(12))


@pytest.fixture(scope="module")
def body(tracks):
    return ArticulatedBody(PERSON, estimate_rest_pose(tracks))


@pytest.fixture(scope="module")
def base(tracks, body):
    """Return the arguments of both trainees."""
    validation = filmed(walks(3, seed=1), views=4)
    return {"tracks": tracks, "validation": validation, "size": TINY, "body": body, "distance": 7.0}


@pytest.fixture(scope="module")
def first(base):
    return PoseTrainee(**base)


def shortened(tracks, frames):
    return [
        replace(track, keypoints=track.keypoints[:frames], confidence=track.confidence[:frames])
        for track in tracks
    ]


@pytest.fixture(scope="module")
def teacher(first, tmp_path_factory):
    folder = tmp_path_factory.mktemp("poses")
    settings = replace(usual_motion_vae_training("tiny")[0], steps=150)
    train(first, settings, folder, progress=False)
    return first.learnt(folder)


@pytest.fixture(scope="module")
def learnt(base, teacher, tmp_path_factory):
    """Train the second phase on four sequences, which the tiny network memorises in seconds."""
    sequences = shortened(base["tracks"][:4], 10)
    given = base | {"tracks": sequences, "validation": sequences}
    trainee = MotionVAETrainee(**given, pose_network=copy.deepcopy(teacher))
    # E_s and D_s start from the pose network.
    for part in ("frame_encoder", "bone_decoder"):
        initial = getattr(trainee.network.vae, part).state_dict()
        for name, value in getattr(teacher, part).state_dict().items():
            assert torch.equal(initial[name], value), name
    with torch.no_grad():
        initial_loss = trainee.validation_loss(trainee.network.eval(), CPU)
    folder = tmp_path_factory.mktemp("vae")
    settings = replace(usual_motion_vae_training("tiny")[1], steps=220, checkpoint_every=220)
    result = train(trainee, settings, folder, progress=False)
    return trainee, initial_loss, result, MotionVAE.load(folder, codes=None)


def test_first_phase_learns_the_view(teacher, body):
    """Chance levels are a quarter of the views and half of the depths."""
    accuracy = evaluate_hypotheses(teacher, TINY, body, walks(6, seed=2), n=200, fps=10.0)
    assert accuracy.right > 0.6
    assert accuracy.depth_right > 0.6


def test_rest_losses_ignore_bone_rotations_and_lengths(first):
    keypoints, seen, rest = first._inputs(first.batches.draw(np.random.default_rng(0), 16), CPU)
    with torch.no_grad():
        hypotheses = first.network.eval()(keypoints, seen, rest)
        before = first._rest_losses(hypotheses, keypoints, seen)
        turns = torch.randn(hypotheses.turns.shape, generator=torch.Generator().manual_seed(0))
        bent = replace(hypotheses, turns=turns, log_lengths=hypotheses.log_lengths + 0.5)
        after = first._rest_losses(bent, keypoints, seen)
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    assert (before.max(dim=1).values > 1.1 * before.min(dim=1).values).all()
    assert len(before.argmin(dim=1).unique()) > 1


@pytest.mark.parametrize("step", [1, 500, 501])
def test_loss_selects_hypotheses_by_the_rest_pose_first(first, step):
    network = copy.deepcopy(first.network)
    with torch.no_grad():
        # Make the bone rotations large, so that the two criteria differ.
        network.bone_decoder.leave.weight.mul_(300)
    trainee = copy.copy(first)
    trainee.anneal(step)
    loss = trainee.training_loss(network, np.random.default_rng(0), 16, CPU)
    drawn = first.batches.draw(np.random.default_rng(0), 16)
    keypoints, seen, rest = first._inputs(drawn, CPU)
    confidence = torch.as_tensor(drawn.confidence)
    hypotheses = network(keypoints, seen, rest)
    terms = hypothesis_losses(first.body, hypotheses, keypoints, confidence, 7.0)
    losses = weighted_sum(terms, TINY)
    best = first._rest_losses(hypotheses, keypoints, confidence).argmin(dim=1)
    assert (best != losses.argmin(dim=1)).any()
    if step > 500:
        best = losses.argmin(dim=1)
    expected = losses[torch.arange(16), best].mean() + 0.05 * losses.mean()
    torch.testing.assert_close(loss, expected)
    assert loss.requires_grad


def test_second_phase_learns_with_a_fixed_teacher(learnt, teacher):
    _, initial_loss, result, prior = learnt
    assert result.saved["validation_loss"] < 0.4 * initial_loss
    for name, value in prior.model.pose.state_dict().items():
        assert torch.equal(value, teacher.state_dict()[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_short_training_yields_3d_walks(base, body, tmp_path, seed):
    given = base | {"size": MotionVAESettings.small(), "seed": seed}
    poses, vae, _ = usual_motion_vae_training("small")
    first = PoseTrainee(**given)
    train(first, replace(poses, steps=800), tmp_path / "poses", progress=False)
    teacher = first.learnt(tmp_path / "poses")
    accuracy = evaluate_hypotheses(teacher, given["size"], body, walks(6, seed=2), n=500, fps=10.0)
    assert min(accuracy.right, accuracy.depth_right) > 0.95
    assert accuracy.error < 0.09
    second = MotionVAETrainee(**given, pose_network=teacher)
    train(second, replace(vae, steps=800), tmp_path / "vae", progress=False)
    drawn = MotionVAE.load(tmp_path / "vae", codes=None).sample(np.random.default_rng(0), 100)
    left, right = (drawn[:, :, PERSON.index(f"{side}_ankle")] for side in ("left", "right"))
    # The feet alternate in front by decimetres, and left stays left.
    offset = left[..., 2] - right[..., 2]
    assert 0.15 < offset.std() < 0.5
    assert (np.ptp(offset, axis=1) > 0.2).mean() > 0.8
    assert (left[..., 0] > right[..., 0]).mean() > 0.9


def test_second_phase_loss_is_the_weighted_sum_of_its_terms(learnt, monkeypatch):
    trainee, _, _, prior = learnt
    terms = {}
    teacher_poses = trainee._teacher_poses

    def with_default_weights(*given):
        weights, trainee.size = trainee.size, TINY
        try:
            return teacher_poses(*given)
        finally:
            trainee.size = weights

    # The weights also select the hypothesis.
    monkeypatch.setattr(trainee, "_teacher_poses", with_default_weights)
    names = ("reconstruction", "smoothness", "ranges", "kl", "teacher")
    for name in names:
        trainee.size = replace(TINY, **dict.fromkeys(names, 0.0) | {name: 1.0})
        terms[name] = trainee.validation_loss(prior.model, CPU)
    trainee.size = TINY
    total = sum(getattr(TINY, name) * value for name, value in terms.items())
    assert trainee.validation_loss(prior.model, CPU) == pytest.approx(total, rel=1e-5)
    assert all(value > 0 for name, value in terms.items() if name != "ranges")


def test_training_does_not_depend_on_depth():
    """Bodies flattened along the viewing direction give the same projections and loss."""
    filming = Filming(elevation=0.0, tilt=0.0, perspective=False)
    clips, flat = walks(6), []
    for clip in clips:
        axis = filming.cameras(seeds.generator(0, "filming", clip.name), 1).rotation[0, 2]
        flat.append(
            replace(clip, positions=clip.positions - (clip.positions @ axis)[..., None] * axis)
        )
        assert np.linalg.norm(clip.positions - flat[-1].positions, axis=-1).max() > 0.2
    losses = []
    for motions in (clips, flat):
        projections = film_clips(
            motions, PERSON, 10.0, views=1, filming=filming, noise=DetectorNoise.none()
        ).tracks
        body = ArticulatedBody(PERSON, estimate_rest_pose(projections[2:]))
        given = projections[2:], projections[:2], TINY, body
        first = PoseTrainee(*given)
        for trainee in (first, MotionVAETrainee(*given, copy.deepcopy(first.network))):
            loss = trainee.training_loss(trainee.network, np.random.default_rng(0), 8, CPU)
            losses.append(float(loss.detach()))
    np.testing.assert_allclose(losses[:2], losses[2:], rtol=1e-5)


@pytest.mark.parametrize("phase", [1, 2])
def test_loss_is_linear_in_confidence(base, phase):
    """The loss is linear for a single view hypothesis only."""
    losses = {}
    for confidence in (1.0, 0.7, 0.4):
        tracks = [replace(track, confidence=track.confidence.copy()) for track in base["tracks"]]
        for track in tracks:
            track.confidence[:, ANKLES] = confidence * (track.confidence[:, ANKLES] > 0)
        given = base | {"tracks": tracks, "size": replace(TINY, hypotheses=1)}
        trainee = PoseTrainee(**given)
        if phase == 2:
            trainee = MotionVAETrainee(**given, pose_network=trainee.network)
        with torch.no_grad():
            network = trainee.network.eval()
            loss = trainee.training_loss(network, np.random.default_rng(0), 16, CPU)
        losses[confidence] = float(loss)
    assert losses[1.0] > 1.01 * losses[0.4]
    assert losses[0.7] == pytest.approx((losses[1.0] + losses[0.4]) / 2, rel=1e-5)


def test_short_tracks_are_skipped(base):
    tracks = base["tracks"]
    given = base | {"tracks": [*tracks, *shortened(tracks[:2], 5)]}
    with pytest.warns(UserWarning, match="2 of .* tracks are shorter than 10 frames and are skip"):
        trainee = PoseTrainee(**given)
    assert trainee.settings["data"]["tracks"] == len(tracks)


@pytest.mark.parametrize(("last", "parent"), [("tip", 2), ("right_hand", 0)])
def test_asymmetric_bodies_warn_and_are_not_mirrored(last, parent):
    skeleton = Skeleton(["root", "chest", "left_hand", last], [-1, 0, 1, parent])
    keypoints = 0.3 * np.random.default_rng(0).normal(size=(20, 4, 2))
    keypoints[:, 0] = 0.0
    track = KeypointTrack(keypoints, np.ones((20, 4)), skeleton, 10.0, "body/0")
    body = ArticulatedBody(skeleton, np.array([[0, 0, 0], [0, 0.3, 0], [0.2, 0, 0], [-0.2, 0, 0]]))
    with pytest.warns(UserWarning, match="body is not left-right symmetric"):
        trainee = PoseTrainee([track], [track], TINY, body)
    assert not trainee.batches.augmentation.mirror


def test_invalid_inputs_are_rejected(base, body):
    occluded = [replace(track, confidence=track.confidence.copy()) for track in base["tracks"]]
    for track in occluded:
        track.confidence[:, ANKLES] = 0
    moving = film_clips(walks(3), PERSON, 10.0, views=2, filming=Filming(centre="sequence")).tracks
    faster = [replace(track, fps=20.0) for track in base["validation"]]
    order = [*range(1, 14), 0]
    parents = [order.index(PERSON.parents[j]) if PERSON.parents[j] >= 0 else -1 for j in order]
    permuted = Skeleton([PERSON.joint_names[j] for j in order], parents)
    point = ArticulatedBody(Skeleton(["point"], [-1]), np.zeros((1, 3)))
    for change, message in (
        ({"size": replace(TINY, image_features=8)}, "size must have image_features=0"),
        ({"distance": -1.0}, "distance must be a finite number above 0"),
        ({"distance": 0.1}, r"distance must exceed the body's reach of .* got 0\.1 m"),
        ({"tracks": shortened(base["tracks"], 6)}, "tracks must .* at least 10 frames, got at mo"),
        ({"tracks": occluded}, "left_ankle, right_ankle"),
        ({"tracks": moving}, "tracks must have the root at the origin in every frame"),
        ({"validation": moving}, "validation must have the root at the origin in every frame"),
        ({"validation": faster}, "validation must have the frame rate"),
        ({"body": ArticulatedBody(permuted, body.rest[order])}, "must have the body's joints"),
        ({"body": point}, "body must have bones, got one joint point"),
    ):
        with pytest.raises(ValueError, match=message):
            PoseTrainee(**base | change)
    wide = PoseNetwork(replace(TINY, width=64), 14, len(body.bones), body.n_groups)
    other = PoseNetwork(TINY, 12, len(body.bones), body.n_groups)
    for network, message in ((wide, "pose_network must have the width"), (other, r"got \(12,")):
        with pytest.raises(ValueError, match=message):
            MotionVAETrainee(**base, pose_network=network)
    with pytest.raises(ValueError, match="size must be one of tiny, small, paper, got 'huge'"):
        usual_motion_vae_training("huge")

"""A motion VAE learnt from 2D tracks: which view is right, what is learnt from, what is refused."""

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
from probmotion.models.dvae.variational_terms import gaussian_kl
from probmotion.models.training.trainer import train
from probmotion.models.vae import network as motion_vae_network
from probmotion.models.vae.losses import guess_terms, weighted_sum
from probmotion.models.vae.model import MotionVAEModel
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.network import MotionVAENetwork
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee, PoseTrainee, usual_motion_vae_training
from probmotion.models.vae.view_hypotheses import judge_hypotheses
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton

CPU = torch.device("cpu")
PERSON = Skeleton.preset("person14")
TINY = MotionVAESettings.tiny()


def walks(n: int, seed: int = 0) -> list[Motion]:
    return make_gaits(n, styles={"walk": 1.0}, frames=90, seed=seed)


def filmed(clips: list[Motion], views: int = 8) -> list[KeypointTrack]:
    return film_clips(clips, PERSON, 10.0, views=views, noise=DetectorNoise(share=0.0)).tracks


@pytest.fixture(scope="module")
def tracks() -> list[KeypointTrack]:
    return filmed(walks(12))


@pytest.fixture(scope="module")
def validation() -> list[KeypointTrack]:
    return filmed(walks(3, seed=1), views=4)


@pytest.fixture(scope="module")
def body(tracks: list[KeypointTrack]) -> ArticulatedBody:
    return ArticulatedBody(PERSON, estimate_rest_pose(tracks))


@pytest.fixture(scope="module")
def first(tracks, validation, body) -> PoseTrainee:
    return PoseTrainee(tracks, validation, TINY, body, distance=7.0)


@pytest.fixture(scope="module")
def poses(first: PoseTrainee, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("poses")
    return folder, train(first, usual_motion_vae_training("tiny")[0], folder, progress=False)


@pytest.fixture(scope="module")
def learnt(tracks, body, first, poses, tmp_path_factory):
    """The second phase on four sequences, which the tiny size can learn by heart in seconds."""
    few = [replace(t, keypoints=t.keypoints[:10], confidence=t.confidence[:10]) for t in tracks[:4]]
    teacher = first.learnt(poses[0])
    trainee = MotionVAETrainee(few, few, TINY, body, teacher, distance=7.0)
    with torch.no_grad():
        begun = trainee.validation_loss(trainee.network.eval(), CPU)
    folder = tmp_path_factory.mktemp("vae")
    settings = replace(usual_motion_vae_training("tiny")[1], steps=600, checkpoint_every=600)
    result = train(trainee, settings, folder, progress=False)
    return trainee, begun, result, MotionVAE.load(folder)


def test_the_first_phase_learns_which_view_is_right(poses, first, body) -> None:
    judged = judge_hypotheses(first.learnt(poses[0]), TINY, body, walks(6, seed=2), n=200, fps=10.0)
    # By chance a fourth of the views would be right, and half of the depths.
    assert judged.right > 0.6
    assert judged.depth_right > 0.6


def test_a_view_is_chosen_with_the_body_at_rest(first) -> None:
    """Bones that bend into the picture of a wrong view do not make it the one that learns."""
    drawn = first._shown(first.batches.draw(np.random.default_rng(0), 16), CPU)
    keypoints, seen, rest = drawn
    with torch.no_grad():
        guesses = first.network.eval()(keypoints, seen, rest)
        before = first._at_rest(guesses, keypoints, seen)
        bent = replace(
            guesses,
            turns=torch.randn(guesses.turns.shape, generator=torch.Generator().manual_seed(0)),
            log_lengths=guesses.log_lengths + 0.5,
        )
        after = first._at_rest(bent, keypoints, seen)
        others = replace(
            guesses,
            rotation=guesses.rotation.roll(1, dims=1),
            translation=guesses.translation.roll(1, dims=1),
        )
        rolled = first._at_rest(others, keypoints, seen)
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    torch.testing.assert_close(rolled, before.roll(1, dims=1))
    # The least of four losses that differ: no view is chosen for its place in the row.
    assert (before.max(dim=1).values > 1.1 * before.min(dim=1).values).all()
    assert len(before.argmin(dim=1).unique()) > 1


@pytest.mark.parametrize("step", [1, 500, 501])
def test_who_learns_is_first_who_fits_at_rest_and_a_little_of_the_others(first, step) -> None:
    network = copy.deepcopy(first.network)
    with torch.no_grad():
        # Bones far from rest, so that the two ways to choose differ.
        network.bone_decoder.leave.weight.mul_(300)
    asked = copy.copy(first)
    asked.anneal(step)
    loss = asked.training_loss(network, np.random.default_rng(0), 16, CPU)
    drawn = first.batches.draw(np.random.default_rng(0), 16)
    keypoints, seen, rest = first._shown(drawn, CPU)
    confidence = torch.as_tensor(drawn.confidence)
    guesses = network(keypoints, seen, rest)
    terms = guess_terms(first.body, guesses, keypoints, confidence, 7.0)
    losses = weighted_sum(terms, TINY)
    best = first._at_rest(guesses, keypoints, confidence).argmin(dim=1)
    assert (best != losses.argmin(dim=1)).any()
    if step > 500:
        best = losses.argmin(dim=1)
    expected = losses[torch.arange(16), best].mean() + 0.05 * losses.mean()
    torch.testing.assert_close(loss, expected)
    assert loss.requires_grad


def test_what_is_watched_does_not_depend_on_the_step(first) -> None:
    asked = copy.copy(first)
    values = []
    for step in (1, 501):
        asked.anneal(step)
        with torch.no_grad():
            values.append(asked.validation_loss(asked.network.eval(), CPU))
    assert values[0] == values[1]


def test_the_second_phase_learns_and_leaves_the_first_as_it_is(learnt, poses, first) -> None:
    _, begun, result, prior = learnt
    assert result.kept["validation_loss"] < 0.25 * begun
    kept = first.learnt(poses[0]).state_dict()
    for name, value in prior.model.pose.state_dict().items():
        np.testing.assert_array_equal(value, kept[name], err_msg=name)


@pytest.mark.slow
def test_minutes_of_learning_give_3d_walks(tracks, validation, body, tmp_path) -> None:
    size = MotionVAESettings.small()
    poses, vae = usual_motion_vae_training("small")
    first = PoseTrainee(tracks, validation, size, body, distance=7.0)
    train(first, replace(poses, steps=800), tmp_path / "poses", progress=False)
    teacher = first.learnt(tmp_path / "poses")
    judged = judge_hypotheses(teacher, size, body, walks(6, seed=2), n=500, fps=10.0)
    assert judged.right > 0.95
    assert judged.depth_right > 0.95
    assert judged.error < 0.09
    second = MotionVAETrainee(tracks, validation, size, body, teacher, distance=7.0)
    train(second, replace(vae, steps=800), tmp_path / "vae", progress=False)
    drawn = MotionVAE.load(tmp_path / "vae").sample(np.random.default_rng(0), 100)
    ankles = [PERSON.index("left_ankle"), PERSON.index("right_ankle")]
    apart = drawn[:, :, ankles[0], 2] - drawn[:, :, ankles[1], 2]
    # One foot and then the other is in front, some decimetres; and the left stays left.
    assert 0.15 < apart.std() < 0.5
    assert (np.ptp(apart, axis=1) > 0.2).mean() > 0.8
    assert (drawn[..., ankles[0], 0] > drawn[..., ankles[1], 0]).mean() > 0.9


def test_a_second_phase_s_loss_is_the_sum_of_its_terms(learnt, monkeypatch) -> None:
    trainee, _, _, prior = learnt
    network = prior.model
    assert isinstance(network, MotionVAEModel)
    only = {"reconstruction": 0.0, "smoothness": 0.0, "ranges": 0.0, "teacher": 0.0}
    found = {}
    taught = trainee._taught

    def by_the_usual_weights(*given):
        asked, trainee.size = trainee.size, TINY
        try:
            return taught(*given)
        finally:
            trainee.size = asked

    # Which view is best is chosen by the weights, too.
    monkeypatch.setattr(trainee, "_taught", by_the_usual_weights)
    for name in (*only, "kl"):
        weights = {**only, "kl": 0.0, name: 1.0}
        trainee.size = replace(TINY, **weights)
        found[name] = trainee.validation_loss(network, CPU)
    trainee.size = TINY
    total = sum(getattr(TINY, name) * value for name, value in found.items())
    assert trainee.validation_loss(network, CPU) == pytest.approx(total, rel=1e-5)
    assert all(value > 0 for name, value in found.items() if name != "ranges")


def test_the_divergence_is_that_of_equation_6_put_right() -> None:
    rng = np.random.default_rng(0)
    mean, log_variance = torch.tensor(rng.normal(size=(2, 5, 4)))
    zero = torch.zeros_like(mean)
    found = gaussian_kl(mean, 0.5 * log_variance, zero, zero)
    expected = -0.5 * (log_variance - log_variance.exp() - mean**2 + 1).sum(dim=-1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_nothing_is_learnt_from_the_third_dimension() -> None:
    """Bodies that are flat to the camera give the same pictures, and the same loss."""
    filming = Filming(elevation=0.0, tilt=0.0, perspective=False)
    clips = walks(6)
    flat = []
    for clip in clips:
        away = filming.cameras(seeds.generator(0, "filming", clip.name), 1).rotation[0, 2]
        positions = clip.positions - (clip.positions @ away)[..., None] * away
        flat.append(replace(clip, positions=positions))
    for clip, other in zip(clips, flat, strict=True):
        assert np.linalg.norm(clip.positions - other.positions, axis=-1).max() > 0.2
    losses = []
    for motions in (clips, flat):
        pictures = film_clips(
            motions, PERSON, 10.0, views=1, filming=filming, noise=DetectorNoise.none()
        ).tracks
        held_out, seen = pictures[:2], pictures[2:]
        given = ArticulatedBody(PERSON, estimate_rest_pose(seen))
        trainee = PoseTrainee(seen, held_out, TINY, given)
        loss = trainee.training_loss(trainee.network, np.random.default_rng(0), 8, CPU)
        with torch.no_grad():
            held = trainee.validation_loss(trainee.network.eval(), CPU)
        second = MotionVAETrainee(seen, held_out, TINY, given, copy.deepcopy(trainee.network))
        said = second.training_loss(second.network, np.random.default_rng(0), 8, CPU)
        losses.append((float(loss.detach()), held, float(said.detach())))
    np.testing.assert_allclose(losses[0], losses[1], rtol=1e-5)


def test_the_second_phase_begins_with_what_the_first_has_learnt(
    tracks, validation, body, first
) -> None:
    network = MotionVAETrainee(
        tracks, validation, TINY, body, copy.deepcopy(first.network), distance=7.0
    ).network
    for part in ("frame_encoder", "bone_decoder"):
        ours = getattr(network.vae, part).state_dict()
        for name, value in getattr(first.network, part).state_dict().items():
            np.testing.assert_array_equal(ours[name], value, err_msg=f"{part} {name}")


def test_codes_hear_more_of_the_frames_through_small_tokens(first, monkeypatch) -> None:
    given = first._shown(first.batches.draw(np.random.default_rng(0), 32), CPU)
    apart = []
    for size in (motion_vae_network._FIRST_ASKED, 1.0):
        monkeypatch.setattr(motion_vae_network, "_FIRST_ASKED", size)
        network = MotionVAENetwork(TINY, PERSON.n_joints, len(first.body.bones))
        with torch.no_grad():
            apart.append(float(network.encode(*given)[0].std(dim=0).mean()))
    assert apart[0] > 2 * apart[1]


def test_what_cannot_be_learnt_with_is_refused_in_a_sentence(tracks, validation, body, first):
    def asked(size=TINY, distance=7.0):
        return PoseTrainee(tracks, validation, size, body, distance=distance)

    with pytest.raises(ValueError, match="size has image_features=8, expected 0: tracks have none"):
        asked(replace(TINY, image_features=8))
    for distance in (-1.0, np.nan):
        with pytest.raises(ValueError, match=r"distance must be a finite number above 0, got .*"):
            asked(distance=distance)
    with pytest.raises(ValueError, match=r"distance is 0\.1 m, expected more than the body's own"):
        asked(distance=0.1)
    wide = asked(replace(TINY, width=64)).network
    with pytest.raises(ValueError, match=r"pose_network has width, .* expected the size's \(32, "):
        MotionVAETrainee(tracks, validation, TINY, body, wide, distance=7.0)
    of_another = PoseNetwork(TINY, 12, len(body.bones), body.n_groups)
    with pytest.raises(ValueError, match=r"pose_network is of a body with 12 joints, .* body's 14"):
        MotionVAETrainee(tracks, validation, TINY, body, of_another, distance=7.0)
    point = Skeleton(["point"], [-1])
    still = [KeypointTrack(np.zeros((20, 1, 2)), np.ones((20, 1)), point, 10.0, "still")]
    with pytest.raises(ValueError, match="body has the one joint point, expected bones"):
        PoseTrainee(still, still, TINY, ArticulatedBody(point, np.zeros((1, 3))))


@pytest.mark.parametrize("phase", [1, 2])
def test_what_is_seen_less_surely_counts_less(tracks, validation, body, phase) -> None:
    """Where a body has one view to choose from, the loss is linear in a joint's confidence."""
    size, losses = replace(TINY, hypotheses=1), {}
    ankles = [PERSON.index("left_ankle"), PERSON.index("right_ankle")]
    for confidence in (1.0, 0.7, 0.4):
        doubted = []
        for track in tracks:
            held = track.confidence.copy()
            held[:, ankles] = np.where(held[:, ankles] > 0, confidence, 0.0)
            doubted.append(replace(track, confidence=held))
        trainee = PoseTrainee(doubted, validation, size, body, distance=7.0)
        if phase == 2:
            teacher = trainee.network
            trainee = MotionVAETrainee(doubted, validation, size, body, teacher, distance=7.0)
        with torch.no_grad():
            network = trainee.network.eval()
            loss = trainee.training_loss(network, np.random.default_rng(0), 16, CPU)
        losses[confidence] = float(loss)
    assert losses[1.0] > 1.01 * losses[0.4]
    assert losses[0.7] == pytest.approx((losses[1.0] + losses[0.4]) / 2, rel=1e-5)


def test_tracks_that_are_not_centred_in_every_frame_are_refused(tracks, validation, body) -> None:
    moving = film_clips(walks(3), PERSON, 10.0, views=2, filming=Filming(centre="sequence")).tracks
    with pytest.raises(ValueError, match=r"tracks has .* with its root .* m from the origin, expe"):
        PoseTrainee(moving, validation, TINY, body, distance=7.0)
    with pytest.raises(ValueError, match=r"validation has .* with its root .* m from the origin"):
        PoseTrainee(tracks, moving, TINY, body, distance=7.0)


def test_short_tracks_among_long_ones_are_left_out_and_counted(tracks, validation, body) -> None:
    short = replace(
        tracks[0], keypoints=tracks[0].keypoints[:5], confidence=tracks[0].confidence[:5]
    )
    with pytest.warns(UserWarning, match="2 of .* in tracks are shorter than a sequence's 10 fram"):
        trainee = PoseTrainee([*tracks, short, short], validation, TINY, body, distance=7.0)
    assert trainee.settings["data"]["tracks"] == len(tracks)


def test_a_body_without_pairs_is_said_to_have_none() -> None:
    arm = Skeleton(["root", "elbow", "hand"], [-1, 0, 1])
    rng = np.random.default_rng(0)
    keypoints = 0.3 * rng.normal(size=(20, 3, 2))
    keypoints[:, 0] = 0.0
    track = KeypointTrack(keypoints, np.ones((20, 3)), arm, 10.0, "arm/0")
    body = ArticulatedBody(arm, np.array([[0, 0, 0], [0, 0.3, 0], [0, 0.2, 0.1]]))
    with pytest.warns(UserWarning, match="body has no left-right pairs: no bone is"):
        trainee = PoseTrainee([track], [track], TINY, body)
    assert not trainee.batches.augmentation.mirror


def test_a_body_whose_pairs_hang_from_different_joints_is_said_to_be_lopsided() -> None:
    lopsided = Skeleton(["root", "chest", "left_hand", "right_hand"], [-1, 0, 1, 0])
    keypoints = 0.3 * np.random.default_rng(0).normal(size=(20, 4, 2))
    keypoints[:, 0] = 0.0
    track = KeypointTrack(keypoints, np.ones((20, 4)), lopsided, 10.0, "lopsided/0")
    body = ArticulatedBody(lopsided, np.array([[0, 0, 0], [0, 0.3, 0], [0.2, 0, 0], [-0.2, 0, 0]]))
    with pytest.warns(UserWarning, match="body has no left-right pairs that hang from one joint"):
        trainee = PoseTrainee([track], [track], TINY, body)
    assert not trainee.batches.augmentation.mirror


def test_bad_input_is_refused_in_a_sentence(tracks, validation, body) -> None:
    short = [replace(t, keypoints=t.keypoints[:6], confidence=t.confidence[:6]) for t in tracks]
    with pytest.raises(ValueError, match="tracks has at most 6 frames a track, expected a seq"):
        PoseTrainee(short, validation, TINY, body)
    blind = []
    for track in tracks:
        confidence = track.confidence.copy()
        confidence[:, [PERSON.index("left_ankle"), PERSON.index("right_ankle")]] = 0
        blind.append(replace(track, confidence=confidence))
    with pytest.raises(ValueError, match="tracks never shows left_ankle, right_ankle"):
        PoseTrainee(blind, validation, TINY, body)
    faster = [replace(track, fps=20.0) for track in validation]
    with pytest.raises(ValueError, match="validation is at 20 frames per second, expected"):
        PoseTrainee(tracks, faster, TINY, body)
    order = [*range(1, 14), 0]
    names = Skeleton([PERSON.joint_names[j] for j in order],
                     [order.index(PERSON.parents[j]) if PERSON.parents[j] >= 0 else -1
                      for j in order])  # fmt: skip
    other = ArticulatedBody(names, body.rest[order])
    with pytest.raises(ValueError, match="tracks has the joints pelvis, "):
        PoseTrainee(tracks, validation, TINY, other)
    with pytest.raises(ValueError, match="size must be one of tiny, small, paper, got 'huge'"):
        usual_motion_vae_training("huge")

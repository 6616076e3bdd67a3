"""Batches to learn from and batches to watch learning by: of one skeleton and frame rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
from probmotion.models.training.track_batches import Augmentation, learning_and_held_out
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
VARIED = Augmentation(mirror=False, shift=0.5)


def track(seed=0, skeleton=BODY, fps=20.0):
    keypoints = np.random.default_rng(seed).normal(size=(30, skeleton.n_joints, 2))
    return KeypointTrack(keypoints, np.ones(keypoints.shape[:2]), skeleton, fps, f"clip{seed}/0")


def test_only_what_is_learnt_from_is_varied():
    shown, kept = track(0), track(1)
    batches, held_out = learning_and_held_out([shown], [kept], 30, 0.3, VARIED)
    rng = np.random.default_rng(2)
    drawn = held_out.draw(rng, 8)
    assert drawn.valid.all()
    np.testing.assert_allclose(drawn.keypoints, np.stack([kept.keypoints] * 8), atol=1e-6)
    lengths = batches.draw(rng, 50).valid.sum(axis=1)
    assert (lengths < 30).any()
    for one in (batches, held_out):
        assert (one.frames, one.threshold, one.fps, one.skeleton) == (30, 0.3, 20.0, BODY)
    assert (batches.description["clips"], held_out.description["clips"]) == (["clip0"], ["clip1"])


def test_a_joint_that_no_track_shows_is_refused_where_all_are_asked_for():
    confidence = np.ones((30, 4))
    confidence[:, 3] = 0.2
    blind = replace(track(), confidence=confidence)
    batches, _ = learning_and_held_out([blind], [track(1)], 30, 0.25, VARIED)
    assert batches.never_seen == ("head",)
    with pytest.raises(ValueError, match=r"^tracks never shows head with a confidence of 0\.25 or"):
        batches.check_all_seen()
    held = learning_and_held_out([blind, track(2)], [blind], 30, 0.25, VARIED)[0]
    held.check_all_seen()


def test_what_differs_is_refused_in_a_sentence():
    other = Skeleton(["root", "hand"], [-1, 0])
    for validation, sentence in [
        (track(1, skeleton=other), "has another skeleton than tracks, expected the same"),
        (track(1, fps=25.0), "is at 25 frames per second, expected tracks' 20"),
    ]:
        with pytest.raises(ValueError, match=f"^validation {sentence}$"):
            learning_and_held_out([track()], [validation], 30, 0.3, VARIED)
        with pytest.raises(ValueError, match=f"^validation {sentence}$"):
            EvaluatorTrainee([track()], [validation], EvaluatorSettings.tiny())

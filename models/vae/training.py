"""Two-phase training of the motion VAE from 2D tracks (Ponymation, sections 3.2 and 3.3).

The first phase trains the pose network on single frames. The second trains the VAE, with one latent
code per sequence and the pose network as teacher.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.dvae.variational_terms import gaussian_kl
from probmotion.models.training.checkpoints import load_checkpoint, load_weights
from probmotion.models.training.devices import half_precision
from probmotion.models.training.runs import check_same_run
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation, Batch, TrackBatches
from probmotion.models.training.track_trainee import TrackTrainee
from probmotion.models.vae.losses import (
    best_hypothesis,
    hypothesis_losses,
    reconstruction,
    roughness,
    weighted_sum,
)
from probmotion.models.vae.network import (
    KIND,
    MotionVAEModel,
    MotionVAENetwork,
    description_of,
)
from probmotion.models.vae.pose_network import PoseHypotheses, PoseNetwork
from probmotion.models.vae.settings import CONFIDENCE_THRESHOLD, MotionVAESettings
from probmotion.models.vae.teacher_forcing import TeacherForcedPoses, scaled
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["MotionVAETrainee", "PoseTrainee", "usual_motion_vae_training"]

# Weight of the mean loss over all hypotheses, so that unselected ones continue to learn.
_MEAN_LOSS_WEIGHT = 0.05
# Tolerance of the root position for rounding, metres.
_ROOT_TOLERANCE = 1e-3
# Number of initial steps in which hypotheses are selected with the body in its rest pose.
_REST_STEPS = 500


class _VAETrainee(TrackTrainee):
    """Base class with the data and checks of both phases."""

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: MotionVAESettings,
        body: ArticulatedBody,
        *,
        distance: float | None = None,
        threshold: float = CONFIDENCE_THRESHOLD,
        seed: int = 0,
    ) -> None:
        if size.image_features:
            raise ValueError(
                "size must have image_features=0 for training on tracks, got "
                f"{size.image_features}; see MotionVAENetwork.encode"
            )
        if not body.skeleton.bones:
            raise ValueError(f"body must have bones, got one joint {body.skeleton.joint_names[0]}")
        if distance is not None:
            check_positive("distance", distance)
            reach = float(np.linalg.norm(body.rest_positions, axis=-1).max())
            if distance <= reach:
                raise ValueError(
                    f"distance must exceed the body's reach of {reach:.2g} m, got {distance:g} m"
                )
        super().__init__(
            _long_enough("tracks", tracks, size.frames),
            _long_enough("validation", validation, size.frames),
            size,
            threshold=threshold,
            # An asymmetric body cannot be mirrored.
            augmentation=Augmentation(shortest=1.0, mirror=body.symmetric),
            seed=seed,
        )
        self.body, self.distance = body, distance
        if self.batches.skeleton != body.skeleton:
            raise ValueError(
                f"tracks must have the body's joints {', '.join(body.skeleton.joint_names)}, "
                f"got {', '.join(self.batches.skeleton.joint_names)}"
            )
        self.batches.check_all_seen()
        _check_centred("tracks", tracks, threshold)
        _check_centred("validation", validation, threshold)
        if not body.symmetric:
            warnings.warn(
                "body is not left-right symmetric: bone lengths are not shared and tracks are not "
                "mirrored",
                stacklevel=3,
            )
        self.settings = {
            **description_of(size, body, self.batches.fps),
            "distance": distance,
            "threshold": threshold,
            "data": self.batches.description,
            "validation_data": self.held_out.description,
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the mean loss of random sequences.

        Networks use the precision of their settings; kinematics and losses use single precision.
        """
        with half_precision(device, False):
            return super().training_loss(network, rng, batch, device)

    def _inputs(
        self, drawn: Batch, device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return keypoints (n, L, J, 2), visibility (n, L, J) and rest pose (J, 3).

        Network inputs contain visibility instead of confidence, which differs between detectors.
        """
        return (
            torch.as_tensor(drawn.keypoints, device=device),
            torch.as_tensor(drawn.seen, dtype=torch.float32, device=device),
            torch.as_tensor(self.body.rest_positions, dtype=torch.float32, device=device),
        )


class PoseTrainee(_VAETrainee):
    """Trainee of the first phase: the pose network under several view hypotheses.

    The loss of a sequence is that of its best hypothesis plus .05 times the mean over hypotheses.
    Its terms are reprojection error, smoothness, joint ranges and bone lengths. In the first 500
    steps, the best hypothesis is selected with the body in its rest pose.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared tracks: metres, centred, of one skeleton and frame rate.
    validation : sequence of KeypointTrack
        Tracks of held-out clips.
    size : MotionVAESettings
        Network size and loss weights.
    body : ArticulatedBody
        Body of the subjects; its rest pose may be estimated with
        :func:`~probmotion.motion.rest_poses.estimate_rest_pose`.
    distance : float, optional
        Distance of the cameras from the subject, metres; orthographic by default.
    threshold : float
        Minimum confidence of visible joints.
    seed : int
        Seed of the initial weights and the validation sequences.

    Raises
    ------
    ValueError
        If all tracks are shorter than a sequence, tracks differ in skeleton or frame rate, their
        skeleton differs from the body's, or a joint is never visible.
    """

    kind = "motion-vae-poses"

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: MotionVAESettings,
        body: ArticulatedBody,
        **options: Any,
    ) -> None:
        super().__init__(tracks, validation, size, body, **options)
        self.network = self._fresh_network(self._seed)
        self._step = 1

    def _fresh_network(self, seed: int = 0) -> PoseNetwork:
        body = self.body
        return PoseNetwork(self.size, body.skeleton.n_joints, len(body.bones), body.n_groups, seed)

    def anneal(self, step: int) -> None:
        """Set the step, counted from 1, which determines how hypotheses are selected."""
        self._step = step

    def learnt(self, folder: str | Path) -> PoseNetwork:
        """Load the network of a training run.

        Raises ``CheckpointError`` for a damaged file, ``FileNotFoundError`` for a missing one, and
        ``ValueError`` for a run with other settings or data.
        """
        network = self._fresh_network()
        checkpoint = load_checkpoint(folder, self.kind)
        check_same_run(checkpoint.settings, {"network": dict(self.settings)}, Path(folder))
        load_weights(network, checkpoint.tensors, self.kind)
        return network

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        drawn = batches.draw(rng, n)
        keypoints, seen, rest = self._inputs(drawn, device)
        hypotheses = network(keypoints, seen, rest)
        confidence = torch.as_tensor(drawn.confidence, device=device)
        terms = hypothesis_losses(self.body, hypotheses, keypoints, confidence, self.distance)
        losses = weighted_sum(terms, self.size)
        at_rest = batches is self.batches and self._step <= _REST_STEPS
        selection = self._rest_losses(hypotheses, keypoints, confidence) if at_rest else losses
        best = selection.argmin(dim=1, keepdim=True)
        return losses.gather(1, best).mean() + _MEAN_LOSS_WEIGHT * losses.mean()

    @torch.no_grad()
    def _rest_losses(
        self, hypotheses: PoseHypotheses, keypoints: torch.Tensor, confidence: torch.Tensor
    ) -> torch.Tensor:
        """Return the losses of all views with rest-pose bones, (B, H).

        Bone rotations can compensate for a wrong view. With them, the first hypothesis to learn
        would also be selected for other quadrants, and the other hypotheses never.
        """
        rest_pose = replace(
            hypotheses,
            turns=torch.zeros_like(hypotheses.turns),
            log_lengths=torch.zeros_like(hypotheses.log_lengths),
        )
        terms = hypothesis_losses(self.body, rest_pose, keypoints, confidence, self.distance)
        return weighted_sum(terms, self.size)


class MotionVAETrainee(_VAETrainee):
    """Trainee of the second phase: a motion VAE with one latent code per sequence (eqs. 2 to 7).

    E_s and D_s are initialised with the pose network's weights. The pose network is fixed and
    provides the rigid poses.

    Parameters
    ----------
    tracks, validation, size, body, distance, threshold, seed
        As for :class:`PoseTrainee`.
    pose_network : PoseNetwork
        Network of the first phase.

    Raises
    ------
    ValueError
        As for :class:`PoseTrainee`, or if the pose network has another size or body.
    """

    kind = KIND

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: MotionVAESettings,
        body: ArticulatedBody,
        pose_network: PoseNetwork,
        **options: Any,
    ) -> None:
        super().__init__(tracks, validation, size, body, **options)
        vae = MotionVAENetwork(size, body.skeleton.n_joints, len(body.bones), self._seed)
        required, actual = (
            (sizes.width, sizes.layers, sizes.heads, sizes.feedforward, sizes.image_features)
            for sizes in (size, pose_network.settings)
        )
        if required != actual:
            raise ValueError(
                "pose_network must have the width, layers, heads, feedforward and image_features "
                f"of size, {required}, got {actual}"
            )
        counts = (body.skeleton.n_joints, len(body.bones), body.n_groups)
        got = (pose_network.n_joints, pose_network.n_bones, pose_network.n_groups)
        if counts != got:
            raise ValueError(
                f"pose_network must have the body's joints, bones and lengths, {counts}, got {got}"
            )
        teacher = pose_network.eval().requires_grad_(False)
        if size.spatial:
            vae.frame_encoder.load_state_dict(teacher.frame_encoder.state_dict())
            vae.bone_decoder.load_state_dict(teacher.bone_decoder.state_dict())
        self.network = MotionVAEModel(vae, teacher)
        self._teacher = teacher
        self._poses: dict[TrackBatches, TeacherForcedPoses] = {}

    def taught_windows(
        self, rng: np.random.Generator, n: int, device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, PoseHypotheses]:
        """Return keypoints, visibility, rest pose and teacher poses of n random windows."""
        *inputs, _, teacher = self._windows(self.batches, rng, n, device)
        return (*inputs, teacher)

    def _windows(
        self, batches: TrackBatches, rng: np.random.Generator, n: int, device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, PoseHypotheses]:
        """Return keypoints, visibility, rest pose, confidences and teacher poses of windows."""
        drawn = batches.draw(rng, n)
        keypoints, seen, rest = self._inputs(drawn, device)
        confidence = torch.as_tensor(drawn.confidence, device=device)
        teacher = self._teacher_poses(batches, drawn, keypoints, confidence, rest)
        return keypoints, seen, rest, confidence, teacher

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        assert isinstance(network, MotionVAEModel)
        keypoints, seen, rest, confidence, teacher = self._windows(batches, rng, n, device)
        mean, log_variance = network.vae.encode(keypoints, seen, rest)
        noise = rng.standard_normal(tuple(mean.shape), dtype=np.float32)
        latent = mean + (0.5 * log_variance).exp() * torch.as_tensor(noise, device=device)
        turns = network.vae.decode(latent)
        translation = nn.functional.pad(teacher.translation, (0, 1))
        positions = self.body.positions(turns, teacher.rotation, translation, teacher.log_lengths)
        zero = torch.zeros_like(mean)
        terms = {
            "reconstruction": reconstruction(positions, keypoints, confidence, self.distance),
            "smoothness": roughness(turns, teacher.rotation, teacher.translation),
            "ranges": self.body.range_excess(turns).sum(dim=-1),
            # The paper prints equation 6 with σ instead of σ².
            "kl": gaussian_kl(mean, 0.5 * log_variance, zero, zero),
            "teacher": (turns - teacher.turns).square().sum(dim=(-3, -2, -1)),
        }
        return weighted_sum(terms, self.size).mean()

    @torch.no_grad()
    def _teacher_poses(
        self,
        batches: TrackBatches,
        drawn: Batch,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
    ) -> PoseHypotheses:
        """Return the best view hypothesis of the first phase, (B, L, …)."""
        if batches not in self._poses:
            self._poses[batches] = TeacherForcedPoses(self._teacher, batches, rest)
        hypotheses = self._poses[batches].of(drawn)
        scale = torch.as_tensor(drawn.scale, device=keypoints.device)
        # Undo the scaling, which must not affect the selection of the hypothesis.
        unscaled = keypoints / scale[:, None, None, None]
        terms = hypothesis_losses(self.body, hypotheses, unscaled, confidence, self.distance)
        return scaled(best_hypothesis(hypotheses, weighted_sum(terms, self.size)), scale)


def usual_motion_vae_training(size: str) -> tuple[TrainingSettings, ...]:
    """Return the training settings of three phases for a size: ``tiny``, ``small`` or ``paper``.

    The third, run twice, calibrates the encoder. The paper trains the others for 120 and 180
    epochs; ``paper`` assumes 1000 steps per epoch.
    Raises ``ValueError`` for an unknown size.
    """
    tiny = TrainingSettings(steps=300, batch=16, learning_rate=5e-3, ema=0.97)
    small = replace(tiny, steps=2000, batch=32, learning_rate=1e-3, ema=0.995)
    paper = TrainingSettings(steps=120_000, learning_rate=1e-4, warmup=1000)
    known = {
        "tiny": (tiny, tiny, tiny),
        "small": (small, replace(small, steps=2500), replace(small, steps=3000, batch=256)),
        "paper": (paper, replace(paper, steps=180_000), replace(paper, steps=20_000)),
    }
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]


def _check_centred(name: str, tracks: Sequence[KeypointTrack], threshold: float) -> None:
    """Raise ``ValueError`` for tracks with a moving root, because inference centres the root."""
    root = tracks[0].skeleton.roots[0]
    for track in tracks:
        seen = (track.confidence[:, root] >= threshold) & (track.confidence[:, root] > 0)
        offset = np.linalg.norm(track.keypoints[seen, root], axis=-1).max(initial=0.0)
        if offset > _ROOT_TOLERANCE:
            raise ValueError(
                f"{name} must have the root at the origin in every frame, got {offset:.2g} m in "
                f"{track.name or 'a track'}; use prepare_tracks"
            )


def _long_enough(
    name: str, tracks: Sequence[KeypointTrack], frames: int
) -> Sequence[KeypointTrack]:
    """Return the tracks with at least ``frames`` frames."""
    long = [track for track in tracks if track.frames >= frames]
    if tracks and not long:
        raise ValueError(
            f"{name} must contain a track of at least {frames} frames, got at most "
            f"{max(track.frames for track in tracks)}"
        )
    if len(long) < len(tracks):
        warnings.warn(
            f"{len(tracks) - len(long)} of {len(tracks)} {name} are shorter than {frames} frames "
            "and are skipped",
            stacklevel=4,
        )
    return long

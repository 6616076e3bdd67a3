"""Learning a motion VAE from 2D tracks in two phases (Ponymation, sections 3.2 and 3.3).

First a network that sees one frame at a time learns what bodies do in pictures; then the VAE learns
to say it with one latent code a sequence, with the first network as its teacher.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.dvae.variational_terms import gaussian_kl
from probmotion.models.training.checkpoints import load_checkpoint, load_weights
from probmotion.models.training.runs import check_same_run
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import (
    Augmentation,
    Batch,
    TrackBatches,
    learning_and_held_out,
)
from probmotion.models.vae.losses import (
    best_guess,
    guess_terms,
    reconstruction,
    roughness,
    weighted_sum,
)
from probmotion.models.vae.model import KIND, MotionVAEModel, description_of
from probmotion.models.vae.network import MotionVAENetwork
from probmotion.models.vae.pose_network import PoseGuesses, PoseNetwork
from probmotion.models.vae.settings import USUAL_THRESHOLD, MotionVAESettings
from probmotion.models.vae.teacher_forcing import TeacherForcedPoses, scaled
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["MotionVAETrainee", "PoseTrainee", "usual_motion_vae_training"]

_VALIDATION_BATCH = 256
# Of the hypotheses that are not chosen, so that none is left behind for good.
_OTHERS = 0.05
# Metres: rounding, and no motion.
_CENTRED = 1e-3
# Steps in which bones have no say in which hypothesis learns.
_AT_REST = 500


class _LearnsFromTracks:
    """What both phases share: 2D tracks cut into sequences of one length, and a body."""

    kind: str
    network: nn.Module
    settings: Mapping[str, Any]

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: MotionVAESettings,
        body: ArticulatedBody,
        distance: float | None,
        threshold: float,
        seed: int,
    ) -> None:
        # The mirror image of a body without pairs is another body.
        whole = Augmentation(shortest=1.0, mirror=body.symmetric)
        if size.image_features:
            raise ValueError(
                f"size has image_features={size.image_features}, expected 0: tracks have none; "
                "networks read them, see MotionVAENetwork.encode"
            )
        if not body.skeleton.bones:
            raise ValueError(
                f"body has the one joint {body.skeleton.joint_names[0]}, expected bones"
            )
        if distance is not None:
            check_positive("distance", distance)
            reach = float(np.linalg.norm(body.rest_positions, axis=-1).max())
            if distance <= reach:
                raise ValueError(
                    f"distance is {distance:g} m, expected more than the body's own {reach:.2g} m"
                )
        self.size = size
        self.body = body
        self.distance = distance
        self.batches, self.held_out = learning_and_held_out(
            _long_enough("tracks", tracks, size.frames),
            _long_enough("validation", validation, size.frames),
            size.frames,
            threshold,
            whole,
        )
        if self.batches.skeleton != body.skeleton:
            raise ValueError(
                f"tracks has the joints {', '.join(self.batches.skeleton.joint_names)}, expected "
                f"those of the body: {', '.join(body.skeleton.joint_names)}"
            )
        self.batches.check_all_seen()
        _check_centred("tracks", tracks, threshold)
        _check_centred("validation", validation, threshold)
        if not body.symmetric:
            lacks = (
                "left-right pairs that hang from one joint or from a pair"
                if body.skeleton.mirrored_pairs
                else "left-right pairs"
            )
            warnings.warn(
                f"body has no {lacks}: no bone is as long as its mirror image, and no track is "
                "mirrored",
                stacklevel=3,
            )
        self._seed = seed
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
        """Return the loss of fresh sequences, a mean over them.

        Networks multiply as their settings say; where bodies are posed, and what is lost, stays in
        single precision whatever the trainer asks for.
        """
        with torch.autocast(device.type, enabled=False):
            return self._loss(network, self.batches, rng, batch, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out sequences that never change."""
        rng = seeds.generator(self._seed, "validation")
        return float(self._loss(network, self.held_out, rng, _VALIDATION_BATCH, device))

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        raise NotImplementedError

    def _shown(
        self, drawn: Batch, device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return what networks are shown: keypoints (n, L, J, 2), seen (n, L, J), rest (J, 3).

        Of confidence no more than whether a joint is seen, 1 or 0: one detector's numbers are not
        another's, and what networks learnt of the one they would misread in the other.
        """
        return (
            torch.as_tensor(drawn.keypoints, device=device),
            torch.as_tensor(drawn.seen, dtype=torch.float32, device=device),
            torch.as_tensor(self.body.rest_positions, dtype=torch.float32, device=device),
        )


class PoseTrainee(_LearnsFromTracks):
    """The first phase: rigid poses and bones, frame by frame, under several view hypotheses.

    The loss is that of one hypothesis of each sequence: its pictures' squared error, and how far it
    moves from frame to frame, bends joints beyond their ranges and stretches bones. It is the
    hypothesis of the least loss, but for the first 500 steps, in which it is the one that fits best
    with the body at rest.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared: metres, centred, of one skeleton and frame rate. Nothing else is learnt from.
    validation : sequence of KeypointTrack
        Of clips that are not among those of ``tracks``.
    size : MotionVAESettings
        The networks'.
    body : ArticulatedBody
        What moves; its rest pose may be estimated from the tracks, see
        :func:`~probmotion.motion.rest_poses.estimate_rest_pose`.
    distance : float, optional
        Of the cameras from the subject, metres; by default rays are parallel.
    threshold : float
        Least confidence of a joint that is learnt from.
    seed : int
        Of the first weights and the validation's sequences.

    Raises
    ------
    ValueError
        If no track is as long as a sequence, tracks differ in skeleton or frame rate, their
        skeleton is not the body's, or a joint is never seen.
    """

    kind = "motion-vae-poses"

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: MotionVAESettings,
        body: ArticulatedBody,
        *,
        distance: float | None = None,
        threshold: float = USUAL_THRESHOLD,
        seed: int = 0,
    ) -> None:
        super().__init__(tracks, validation, size, body, distance, threshold, seed)
        self.network = PoseNetwork(
            size, body.skeleton.n_joints, len(body.bones), body.n_groups, seed
        )
        self._step = 1

    def anneal(self, step: int) -> None:
        """Be at a step, counted from 1: how the hypothesis that learns is chosen depends on it."""
        self._step = step

    def learnt(self, folder: str | Path) -> PoseNetwork:
        """Return the network that a run has trained.

        Raises
        ------
        CheckpointError
            If the file is damaged or of another network.
        FileNotFoundError
            If there is none.
        ValueError
            If the run had other settings or data.
        """
        size, body = self.size, self.body
        found = PoseNetwork(size, body.skeleton.n_joints, len(body.bones), body.n_groups)
        kept = load_checkpoint(folder, self.kind)
        check_same_run(kept.settings, {"network": dict(self.settings)}, Path(folder))
        load_weights(found, kept.tensors)
        return found

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        drawn = batches.draw(rng, n)
        keypoints, seen, rest = self._shown(drawn, device)
        guesses = network(keypoints, seen, rest)
        confidence = torch.as_tensor(drawn.confidence, device=device)
        terms = guess_terms(self.body, guesses, keypoints, confidence, self.distance)
        losses = weighted_sum(terms, self.size)
        at_rest = batches is self.batches and self._step <= _AT_REST
        judged = self._at_rest(guesses, keypoints, confidence) if at_rest else losses
        best = judged.argmin(dim=1, keepdim=True)
        return losses.gather(1, best).mean() + _OTHERS * losses.mean()

    @torch.no_grad()
    def _at_rest(
        self, guesses: PoseGuesses, keypoints: torch.Tensor, confidence: torch.Tensor
    ) -> torch.Tensor:
        """Return the loss of every view if no bone turned or grew, (B, H).

        Bones that bend can make up for a wrong view: chosen with them, whichever hypothesis learns
        first wins pictures of other quarters and keeps them, and the rest are never chosen.
        """
        stiff = replace(
            guesses,
            turns=torch.zeros_like(guesses.turns),
            log_lengths=torch.zeros_like(guesses.log_lengths),
        )
        terms = guess_terms(self.body, stiff, keypoints, confidence, self.distance)
        return weighted_sum(terms, self.size)


class MotionVAETrainee(_LearnsFromTracks):
    """The second phase: one latent code for the bones of a whole sequence (equations 2 to 7).

    E_s and D_s begin as what the first phase has learnt: what a frame's picture says of its bones
    has not to be found again from a code through which at first nothing comes. Rigid poses stay
    those of the first phase's network, which is kept as it is.

    Parameters
    ----------
    tracks, validation, size, body, distance, threshold, seed
        As for the first phase.
    pose_network : PoseNetwork
        What the first phase has learnt.

    Raises
    ------
    ValueError
        As for the first phase, or if the pose network is of another size or body.
    """

    kind = KIND

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: MotionVAESettings,
        body: ArticulatedBody,
        pose_network: PoseNetwork,
        *,
        distance: float | None = None,
        threshold: float = USUAL_THRESHOLD,
        seed: int = 0,
    ) -> None:
        super().__init__(tracks, validation, size, body, distance, threshold, seed)
        vae = MotionVAENetwork(size, body.skeleton.n_joints, len(body.bones), seed)
        own, theirs = (
            (one.width, one.layers, one.heads, one.feedforward, one.image_features)
            for one in (size, pose_network.settings)
        )
        if own != theirs:
            raise ValueError(
                f"pose_network has width, layers, heads, feedforward and image_features {theirs}, "
                f"expected the size's {own}"
            )
        of_body = (body.skeleton.n_joints, len(body.bones), body.n_groups)
        found = (pose_network.n_joints, pose_network.n_bones, pose_network.n_groups)
        if found != of_body:
            raise ValueError(
                f"pose_network is of a body with {found[0]} joints, {found[1]} bones that turn and "
                f"{found[2]} lengths, expected the body's {of_body[0]}, {of_body[1]} and "
                f"{of_body[2]}"
            )
        teacher = pose_network.eval().requires_grad_(False)
        if size.spatial:
            vae.frame_encoder.load_state_dict(teacher.frame_encoder.state_dict())
            vae.bone_decoder.load_state_dict(teacher.bone_decoder.state_dict())
        self.network = MotionVAEModel(vae, teacher)
        self._teacher = teacher
        self._poses: dict[TrackBatches, TeacherForcedPoses] = {}

    def _loss(
        self,
        network: nn.Module,
        batches: TrackBatches,
        rng: np.random.Generator,
        n: int,
        device: torch.device,
    ) -> torch.Tensor:
        assert isinstance(network, MotionVAEModel)
        drawn = batches.draw(rng, n)
        keypoints, seen, rest = self._shown(drawn, device)
        confidence = torch.as_tensor(drawn.confidence, device=device)
        guess = self._taught(batches, drawn, keypoints, confidence, rest)
        vae = network.vae
        mean, log_variance = vae.encode(keypoints, seen, rest)
        noise = rng.standard_normal(tuple(mean.shape), dtype=np.float32)
        latent = mean + (0.5 * log_variance).exp() * torch.as_tensor(noise, device=device)
        turns = vae.decode(latent)
        translation = nn.functional.pad(guess.translation, (0, 1))
        positions = self.body.positions(turns, guess.rotation, translation, guess.log_lengths)
        zero = torch.zeros_like(mean)
        terms = {
            "reconstruction": reconstruction(positions, keypoints, confidence, self.distance),
            "smoothness": roughness(turns, guess.rotation, guess.translation),
            "ranges": self.body.range_excess(turns).sum(dim=-1),
            # Equation 6 prints it with σ where σ² belongs.
            "kl": gaussian_kl(mean, 0.5 * log_variance, zero, zero),
            "teacher": (turns - guess.turns).square().sum(dim=(-3, -2, -1)),
        }
        return weighted_sum(terms, self.size).mean()

    @torch.no_grad()
    def _taught(
        self,
        batches: TrackBatches,
        drawn: Batch,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
    ) -> PoseGuesses:
        """Return the best view hypothesis of the first phase, (B, L, …)."""
        if batches not in self._poses:
            self._poses[batches] = TeacherForcedPoses(self._teacher, batches, rest)
        guesses = self._poses[batches].of(drawn)
        scale = torch.as_tensor(drawn.scale, device=keypoints.device)
        # Which view is best does not depend on how a window is scaled.
        shown = keypoints / scale[:, None, None, None]
        terms = guess_terms(self.body, guesses, shown, confidence, self.distance)
        return scaled(best_guess(guesses, weighted_sum(terms, self.size)), scale)


def usual_motion_vae_training(size: str) -> tuple[TrainingSettings, TrainingSettings]:
    """Return how the two phases of a size are trained: ``tiny``, ``small`` or ``paper``.

    The paper counts 120 and 180 epochs of its own data; ``paper`` is as many steps of ours.

    Raises
    ------
    ValueError
        If the size is unknown.
    """
    known = {
        "tiny": (
            TrainingSettings(steps=300, batch=16, learning_rate=5e-3, ema=0.97),
            TrainingSettings(steps=300, batch=16, learning_rate=5e-3, ema=0.97),
        ),
        "small": (
            TrainingSettings(steps=2000, batch=32, learning_rate=1e-3, ema=0.995),
            TrainingSettings(steps=2500, batch=32, learning_rate=1e-3, ema=0.995),
        ),
        "paper": (
            TrainingSettings(steps=120_000, learning_rate=1e-4, warmup=1000),
            TrainingSettings(steps=180_000, learning_rate=1e-4, warmup=1000),
        ),
    }
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]


def _check_centred(name: str, tracks: Sequence[KeypointTrack], threshold: float) -> None:
    """Refuse tracks whose root moves: networks that are asked later see it at the origin."""
    root = tracks[0].skeleton.roots[0]
    for track in tracks:
        seen = (track.confidence[:, root] >= threshold) & (track.confidence[:, root] > 0)
        away = np.linalg.norm(track.keypoints[seen, root], axis=-1).max(initial=0.0)
        if away > _CENTRED:
            raise ValueError(
                f"{name} has {track.name or 'one'} with its root {away:.2g} m from the origin, "
                "expected it there in every frame, as prepare_tracks leaves it by default"
            )


def _long_enough(
    name: str, tracks: Sequence[KeypointTrack], frames: int
) -> Sequence[KeypointTrack]:
    """Return the tracks that hold a sequence."""
    found = [track for track in tracks if track.frames >= frames]
    if tracks and not found:
        raise ValueError(
            f"{name} has at most {max(track.frames for track in tracks)} frames a track, expected "
            f"a sequence's {frames} or more"
        )
    if len(found) < len(tracks):
        warnings.warn(
            f"{len(tracks) - len(found)} of {len(tracks)} in {name} are shorter than a sequence's "
            f"{frames} frames, and are left out",
            stacklevel=4,
        )
    return found

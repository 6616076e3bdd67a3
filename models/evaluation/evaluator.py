"""`TrackEvaluator`: features of 2D motions, in which generated and real ones are compared.

The encoder of a variational autoencoder that learnt the 2D data (MAS, section 6.3, after Guo et
al. 2020); the decoder stays with the training.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings, TrackEncoder
from probmotion.models.training.checkpoints import (
    Checkpoint,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from probmotion.models.training.standardisation import Standards
from probmotion.models.training.trainer import check_device
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["KIND", "EvaluatorSettings", "TrackEvaluator"]

KIND = "track-evaluator"
# Chunks always have the same shape, so that a motion's features never depend on its company.
_TOKENS = 1024
_GPU_TOKENS = 200_000
_ENCODER = "encoder."
_OFF_ORIGIN = 1e-6


class TrackEvaluator:
    """Features of 2D motions: the mean of a variational autoencoder's latent.

    Features are coordinates in which motions that look alike to the autoencoder are near each
    other, fit for comparing *sets* of 2D motions by :mod:`probmotion.metrics.generation`. They are
    neither metres nor a likelihood; they know only what the training data varied in; they compare
    only with features of the same file, and of motions at the same frame rate, centring and
    distance of the camera.

    Parameters
    ----------
    encoder : TrackEncoder
        The network.
    settings : EvaluatorSettings
        Its size.
    standards : Standards
        Of the data that it learnt.
    skeleton : Skeleton
        The J joints.
    fps : float
        Frames per second.
    device : str
        ``cpu`` or ``cuda``.
    card : mapping, optional
        What is known of its training.

    Raises
    ------
    ValueError
        If shapes disagree, a number is out of range or the device is not there.
    """

    def __init__(
        self,
        encoder: TrackEncoder,
        settings: EvaluatorSettings,
        standards: Standards,
        skeleton: Skeleton,
        fps: float,
        *,
        device: str = "cpu",
        card: Mapping[str, Any] | None = None,
    ) -> None:
        check_shape("standards", standards.mean, (skeleton.n_joints, 2))
        check_positive("fps", fps)
        self.settings = settings
        self.standards = standards
        self.card = dict(card or {})
        self.skeleton = skeleton
        self.fps = float(fps)
        self._device = check_device(device).type
        self._encoder = encoder.to(self._device).eval().requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path, *, device: str = "cpu") -> TrackEvaluator:
        """Return a trained evaluator.

        Parameters
        ----------
        source : str or Path
            A checkpoint's file, with the decoder or without, the folder of a training run, or the
            name of an evaluator that comes with the package.
        device : str
            ``cpu`` or ``cuda``.

        Raises
        ------
        CheckpointError
            If the file is damaged, of another version or no evaluator.
        FileNotFoundError
            If there is no such file and no such name.
        """
        checkpoint = load_checkpoint(source, KIND)
        kept = checkpoint.settings["network"]
        settings = EvaluatorSettings(**kept["size"])
        skeleton = Skeleton(kept["joint_names"], kept["parents"])
        with torch.random.fork_rng(devices=[]):
            encoder = TrackEncoder(settings, skeleton.n_joints)
        weights = {
            name.removeprefix(_ENCODER): tensor
            for name, tensor in checkpoint.tensors.items()
            if name.startswith(_ENCODER)
        }
        load_weights(encoder, weights)
        standards = Standards(np.array(kept["mean"]), np.array(kept["deviation"]))
        card = checkpoint.settings
        return cls(encoder, settings, standards, skeleton, kept["fps"], device=device, card=card)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write what features need, which is the encoder alone; :meth:`load` reads it.

        Parameters
        ----------
        path : str or Path
            The file, ``.safetensors``.
        half : bool
            Store half-precision weights: half the size, features alike to three digits.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        weights = {_ENCODER + name: tensor for name, tensor in self._encoder.state_dict().items()}
        save_checkpoint(path, Checkpoint(KIND, self.card, weights), half=half)

    @property
    def frames(self) -> int:
        """Most frames of a motion."""
        return self.settings.frames

    def features(self, views: np.ndarray, lengths: np.ndarray | None = None) -> np.ndarray:
        """Return the features of 2D motions, (N, latent) float64.

        A motion's features depend on itself alone, not on the others or on what pads it.

        Parameters
        ----------
        views : ndarray, (N, L, J, 2)
            Metres at the subject's distance, x right and y down, centred as the training data
            were; L is at most ``frames``.
        lengths : ndarray of int, (N,), optional
            Frames of each motion, from 1 to L; the rest is ignored. All L by default.

        Raises
        ------
        ValueError
            If a shape is another, a length out of range, a number not finite, or the root off the
            origin where the training data had it there.
        """
        check_shape("views", views, ("N", "L", self.skeleton.n_joints, 2))
        N, L = views.shape[:2]
        if not 1 <= L <= self.frames:
            raise ValueError(f"views has {L} frames, expected 1 to {self.frames}")
        valid = _valid_frames(lengths, N, L)
        shown = np.where(valid[..., None, None], views, 0.0)
        check_finite("views", shown)
        self._check_centred(shown)
        moves = self.standards.deviation > 0
        scale = np.where(moves, self.standards.deviation, 1.0)
        standardised = np.where(moves, (shown - self.standards.mean) / scale, 0.0)
        features = np.empty((N, self.settings.latent))
        for rows, motions, seen in self._chunks(standardised, valid):
            with torch.inference_mode():
                mean, _ = self._encoder(motions, seen)
            features[rows] = mean[: len(features[rows])].cpu().numpy()
        return features

    def _check_centred(self, views: np.ndarray) -> None:
        root = self.skeleton.roots[0]
        if views.size == 0 or (self.standards.deviation[root] > 0).any():
            return
        off = np.abs(views[:, :, root] - self.standards.mean[root]).max()
        if off > _OFF_ORIGIN:
            raise ValueError(
                f"views has {self.skeleton.joint_names[root]} up to {off:.3g} m off the origin, "
                "expected it there in every frame, as in the training data"
            )

    def _chunks(
        self, motions: np.ndarray, valid: np.ndarray
    ) -> Iterator[tuple[slice, torch.Tensor, torch.Tensor]]:
        """Yield rows of motions, padded to one shape: (n, frames, 2J) and (n, frames)."""
        tokens = _TOKENS if self._device == "cpu" else _GPU_TOKENS
        n = max(1, tokens // (self.frames + 2))
        N, L = valid.shape
        for start in range(0, N, n):
            rows = slice(start, min(start + n, N))
            numbers = np.zeros((n, self.frames, 2 * self.skeleton.n_joints), np.float32)
            seen = np.zeros((n, self.frames), bool)
            some = rows.stop - start
            numbers[:some, :L] = motions[rows].reshape(some, L, -1)
            seen[:some, :L] = valid[rows]
            yield (
                rows,
                torch.as_tensor(numbers, device=self._device),
                torch.as_tensor(seen, device=self._device),
            )


def _valid_frames(lengths: np.ndarray | None, N: int, L: int) -> np.ndarray:
    """Which frames are there, (N, L) bool."""
    if lengths is None:
        return np.ones((N, L), bool)
    counts = np.asarray(lengths)
    check_shape("lengths", counts, (N,))
    if counts.dtype.kind not in "iu" or ((counts < 1) | (counts > L)).any():
        raise ValueError(f"lengths must be integers from 1 to {L}, got {counts}")
    return np.arange(L) < counts[:, None]

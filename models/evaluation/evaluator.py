"""Feature extractor for the comparison of generated and real 2D motions.

The extractor is the encoder of a variational autoencoder trained on 2D data (MAS, section 6.3,
after Guo et al. 2020). The decoder is only used in training.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probmotion.extras import torch
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings, TrackEncoder
from probmotion.models.training.checkpoints import Checkpoint, load_weights, save_checkpoint
from probmotion.models.training.devices import batch_tokens, inference
from probmotion.models.training.track_network import TrackNetwork, load_track_checkpoint
from probmotion.validation import check_finite, check_shape

__all__ = ["KIND", "EvaluatorSettings", "TrackEvaluator"]

KIND = "track-evaluator"
# Tokens per chunk. The fixed shape makes features independent of the batch.
_TOKENS = 1024
_ENCODER = "encoder."  # Prefix of the encoder's weights in a checkpoint.


class TrackEvaluator(TrackNetwork):
    """Feature extractor of 2D motions: the latent mean of a variational autoencoder.

    Use the features to compare sets of motions (:mod:`probmotion.metrics.generation`). They
    reflect only the variation in the training data and are comparable only for the same file,
    frame rate, centring and camera distance. Parameters are those of
    :class:`~probmotion.models.training.track_network.TrackNetwork`.
    """

    settings: EvaluatorSettings

    @classmethod
    def load(cls, source: str | Path, *, device: str = "cpu") -> TrackEvaluator:
        """Return a trained evaluator.

        Parameters
        ----------
        source : str or Path
            A checkpoint, with or without the decoder, the folder of a training run, or the name of
            an evaluator shipped with the package.
        device : str
            ``cpu``, ``cuda``, or ``auto``: ``cuda`` where it is available, else ``cpu``.

        Raises
        ------
        CheckpointError
            If the file is damaged or not an evaluator of this version.
        FileNotFoundError
            If there is no such file or name.
        """
        checkpoint, settings, standards, skeleton, fps = load_track_checkpoint(
            source, KIND, EvaluatorSettings
        )
        with torch.random.fork_rng(devices=[]):
            encoder = TrackEncoder(settings, skeleton.n_joints)
        weights = {
            name.removeprefix(_ENCODER): tensor
            for name, tensor in checkpoint.tensors.items()
            if name.startswith(_ENCODER)
        }
        load_weights(encoder, weights, KIND)
        card = checkpoint.settings
        return cls(encoder, settings, standards, skeleton, fps, device=device, card=card)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the encoder as a checkpoint, optionally in half precision."""
        weights = {_ENCODER + name: tensor for name, tensor in self._network.state_dict().items()}
        save_checkpoint(path, Checkpoint(KIND, self.card, weights), half=half)

    @property
    def frames(self) -> int:
        """Maximum number of frames of a motion."""
        return self.settings.frames

    def features(self, views: np.ndarray, lengths: np.ndarray | None = None) -> np.ndarray:
        """Return the features of 2D motions, (N, latent) float64.

        The features of a motion do not depend on the batch or on padding.

        Parameters
        ----------
        views : ndarray, (N, L, J, 2)
            Metres at the subject's distance, x right and y down, centred like the training data; L
            is at most ``frames``.
        lengths : ndarray of int, (N,), optional
            Number of valid frames of each motion, 1 to L; default L.

        Raises
        ------
        ValueError
            If a shape or length is invalid, a number is not finite, or the root is not at the
            origin although it is in the training data.
        """
        check_shape("views", views, ("N", "L", self.skeleton.n_joints, 2))
        N, L = views.shape[:2]
        if not 1 <= L <= self.frames:
            raise ValueError(f"views must have 1 to {self.frames} frames, got {L}")
        valid = _valid_frames(lengths, N, L)
        views = np.where(valid[..., None, None], views, 0.0)
        check_finite("views", views)
        self._check_centred(views)
        varies = self.standards.deviation > 0
        scale = np.where(varies, self.standards.deviation, 1.0)
        standardised = np.where(varies, (views - self.standards.mean) / scale, 0.0)
        features = np.empty((N, self.settings.latent))
        n = max(1, batch_tokens(self._device, _TOKENS) // (self.frames + 2))
        for start in range(0, N, n):
            chunk = slice(start, min(start + n, N))
            size = chunk.stop - start
            motions = np.zeros((n, self.frames, 2 * self.skeleton.n_joints), np.float32)
            mask = np.zeros((n, self.frames), bool)
            motions[:size, :L] = standardised[chunk].reshape(size, L, -1)
            mask[:size, :L] = valid[chunk]
            inputs = (torch.as_tensor(array, device=self._device) for array in (motions, mask))
            with inference(self._device):
                mean, _ = self._network(*inputs)
            features[chunk] = mean[:size].cpu().numpy()
        return features

    def _check_centred(self, views: np.ndarray) -> None:
        root = self.skeleton.roots[0]
        if views.size == 0 or (self.standards.deviation[root] > 0).any():
            return
        distance = np.abs(views[:, :, root] - self.standards.mean[root]).max()
        if distance > 1e-6:
            raise ValueError(
                f"views must have the {self.skeleton.joint_names[root]} at the origin, as in the "
                f"training data, got a distance of {distance:.3g} m"
            )


def _valid_frames(lengths: np.ndarray | None, N: int, L: int) -> np.ndarray:
    """Return the mask of valid frames, (N, L) bool."""
    if lengths is None:
        return np.ones((N, L), bool)
    counts = np.asarray(lengths)
    check_shape("lengths", counts, (N,))
    if counts.dtype.kind not in "iu" or ((counts < 1) | (counts > L)).any():
        raise ValueError(f"lengths must be integers from 1 to {L}, got {counts}")
    return np.arange(L) < counts[:, None]

"""`MotionVAE`: a prior over articulated motion with one latent code per sequence (Ponymation).

z ~ p(z); bone rotations ξ = D(z); joints X = FK(ξ); trained on 2D tracks. p(z) is N(0, I), as
published, or a mixture fitted to codes. The rigid path (position and orientation of the body per
frame) is not part of the code but a separate parameter.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from probmotion.arrays import Array
from probmotion.extras import torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.latent.code_mixture import CodeMixture, CodePrior
from probmotion.models.latent.row_decoding import decode_rows
from probmotion.models.training.checkpoints import (
    Checkpoint,
    load_checkpoint,
    load_weights,
    save_checkpoint,
    valid_settings,
)
from probmotion.models.vae.inference import VAEEncoder
from probmotion.models.vae.network import KIND, MotionVAEModel, MotionVAENetwork
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.rigid_paths import RigidPath, estimate_body
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.protocols import InferenceNetwork, Likelihood
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["MotionVAE"]

_ROWS = 64  # number of latent codes decoded at once
_CODES = ("weights", "means", "factors")  # stored parts of the mixture


class MotionVAE(CodePrior):
    """Prior over motions of an articulated body, learnt from 2D tracks.

    θ is the latent code z. The rigid path is fixed: by default the body is upright at the
    origin and faces +Z, which suffices without observations. :meth:`placed_by` estimates it from
    keypoints of a known camera.

    Parameters
    ----------
    network : MotionVAENetwork
        Trained encoder and decoder.
    pose_network : PoseNetwork
        Trained network that estimates rigid poses.
    settings : MotionVAESettings
        Settings of both networks.
    body : ArticulatedBody
        Skeleton, rest pose and joint ranges.
    fps : float
        Frames per second.
    rigid : RigidPath, optional
        Root pose per frame; by default upright at the origin.
    log_lengths : ndarray, (G,), optional
        Log bone lengths relative to the rest pose, shared by mirrored bones; 0 by default.
    card : mapping, optional
        Training record.
    inference_network : InferenceNetwork, optional
        Network for amortised inference; the prior's encoder by default.
    codes : CodeMixture, optional
        Distribution of z; N(0, I) by default.

    Raises
    ------
    ValueError
        If shapes are inconsistent or a parameter is out of range.
    """

    stand_ins: ClassVar[Mapping[str, str]] = {
        "Denoises2D": "probmotion.models.diffusion.projected_denoiser.denoiser_of trains a 2D "
        "prior on its projections"
    }
    """Alternatives to unsupported protocols, for error messages of samplers."""

    def __init__(
        self,
        network: MotionVAENetwork,
        pose_network: PoseNetwork,
        settings: MotionVAESettings,
        body: ArticulatedBody,
        fps: float,
        *,
        rigid: RigidPath | None = None,
        log_lengths: np.ndarray | None = None,
        card: Mapping[str, Any] | None = None,
        inference_network: InferenceNetwork | None = None,
        codes: CodeMixture | None = None,
    ) -> None:
        check_positive("fps", fps)
        self.settings = settings
        self.body = body
        self.card = dict(card or {})
        self.rigid = RigidPath.upright(body, settings.frames) if rigid is None else rigid
        self._placed = rigid is not None
        if self.rigid.frames != settings.frames:
            raise ValueError(
                f"rigid must have the prior's {settings.frames} frames, got {self.rigid.frames}"
            )
        self.log_lengths = np.zeros(body.n_groups) if log_lengths is None else log_lengths
        check_shape("log_lengths", self.log_lengths, (body.n_groups,))
        check_finite("log_lengths", self.log_lengths)
        self.codes = CodeMixture.standard(settings.latent) if codes is None else codes
        check_shape("codes.means", self.codes.means, ("K", settings.latent))
        self.inference_network = VAEEncoder() if inference_network is None else inference_network
        self.skeleton, self.frames, self.fps = body.skeleton, settings.frames, float(fps)
        self.model = MotionVAEModel(network, pose_network).eval().requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path, **options: Any) -> MotionVAE:
        """Load a trained prior from a checkpoint file, a run folder or a shipped name.

        ``options`` are ``rigid``, ``log_lengths``, ``inference_network`` and ``codes`` of
        :class:`MotionVAE`. Files without a mixture of codes, such as those of earlier versions and
        of a run of the second phase, have N(0, I), with a warning unless ``codes`` is given.
        Raises ``CheckpointError`` for a damaged file or another kind of network, and
        ``FileNotFoundError`` for a missing one.
        """
        checkpoint = load_checkpoint(source, KIND)
        with valid_settings(source, KIND):
            stored = checkpoint.settings["network"]
            settings = MotionVAESettings(**stored["size"])
            skeleton = Skeleton(stored["joint_names"], stored["parents"])
            body = ArticulatedBody(skeleton, np.array(stored["rest"], dtype=np.float64))
            model = MotionVAEModel.of(settings, body)
            fps = stored["fps"]
        tensors = dict(checkpoint.tensors)
        parts = [tensors.pop(f"codes.{name}") for name in _CODES if f"codes.{name}" in tensors]
        load_weights(model, tensors, KIND)
        if parts:
            with valid_settings(source, KIND):
                stored = CodeMixture(*(values.double().numpy() for values in parts))
            options = {"codes": stored} | options
        elif "codes" not in options:
            warnings.warn(
                f"{source} has no mixture of codes, so that draws come from N(0, I) and are slow; "
                "learn it again with probmotion train motion-vae, or pass codes=None",
                stacklevel=2,
            )
        card = checkpoint.settings
        return cls(model.vae, model.pose, settings, body, fps, card=card, **options)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Save the prior as a checkpoint for :meth:`load`, optionally in half precision.

        The rigid path is not stored. Raises ``ValueError`` if there is no training record.
        """
        if "network" not in self.card:
            raise ValueError("prior must have a training record to be saved; train or load it")
        codes = {f"codes.{name}": torch.as_tensor(getattr(self.codes, name)) for name in _CODES}
        tensors = self.model.state_dict() | codes
        save_checkpoint(path, Checkpoint(KIND, self.card, tensors), half=half)

    def placed(self, rigid: RigidPath, log_lengths: np.ndarray | None = None) -> MotionVAE:
        """Return the prior with another rigid path and, if given, other log bone lengths."""
        return MotionVAE(
            self.model.vae,
            self.model.pose,
            self.settings,
            self.body,
            self.fps,
            rigid=rigid,
            log_lengths=self.log_lengths if log_lengths is None else log_lengths,
            card=self.card,
            inference_network=self.inference_network,
            codes=self.codes,
        )

    def placed_by(self, likelihood: Likelihood) -> MotionVAE:
        """Return the prior with a rigid path estimated from one view by its pose network.

        Path and bone lengths are those of the best view hypothesis
        (:func:`~probmotion.models.vae.rigid_paths.estimate_body`); z determines the bone rotations.
        Raises ``ValueError`` unless the likelihood is keypoints of one view with matching frames,
        frame rate and joints, and a visible joint in every frame.
        """
        if not isinstance(likelihood, Keypoints2D):
            raise ValueError(f"likelihood must be Keypoints2D, got {type(likelihood).__name__}")
        if likelihood.frames != self.frames:
            raise ValueError(
                f"likelihood must have the prior's {self.frames} frames, got {likelihood.frames}"
            )
        fps = likelihood.fps
        if fps is not None and abs(fps - self.fps) > 1e-6 * self.fps:
            raise ValueError(
                f"likelihood must have the prior's {self.fps:g} frames per second, got {fps:g}"
            )
        estimate = estimate_body(self.model.pose, self.settings, self.body, likelihood)
        return self.placed(estimate.path, estimate.log_lengths)

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if the rigid path was not set.

        z does not contain the body's position and orientation; a wrong rigid path would bias it.
        """
        if not self._placed:
            raise ValueError(
                "prior must have a rigid path for observations; set it with "
                "MotionVAE.placed_by(likelihood), or MotionVAE.placed(path) if it is known"
            )

    def motion(self, theta: Array) -> Array:
        """Return FK(D(θ)), ``(…, dim) → (…, L, J, 3)``, metres, Y up; NumPy or torch."""
        shape = (self.frames, self.skeleton.n_joints, 3)
        return decode_rows(self._motion, theta, self.dim, shape, _ROWS)

    def turns(self, theta: Array) -> Array:
        """Return D(θ), ``(…, dim) → (…, L, bones, 3)``: rotation vectors relative to parents."""
        shape = (self.frames, len(self.body.bones), 3)
        return decode_rows(self._decoded_rotations, theta, self.dim, shape, _ROWS)

    def row_by_row(self, theta: np.ndarray) -> np.ndarray:
        """Return :meth:`motion`, ``(n, dim) → (n, L, J, 3)``, bit-identical in any batch.

        Rounding of a matrix product depends on its shape, so all batches have the same shape.
        """
        padding = -len(theta) % _ROWS
        rows = np.pad(theta, [(0, padding), (0, 0)])
        return self.motion(rows)[: len(theta)]

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n motions, (n, L, J, 3), metres; decoded in single precision."""
        return self.row_by_row(self.initial(rng, n).astype(np.float32)).astype(np.float64)

    def _decoded_rotations(self, theta: torch.Tensor) -> torch.Tensor:
        """Decode rows, ``(B, dim) → (B, L, bones, 3)``."""
        # Densities require double precision.
        model = self.model if theta.dtype == torch.float32 else self._double
        return model.vae.decode(theta)

    def _motion(self, theta: torch.Tensor) -> torch.Tensor:
        """Decode rows, ``(B, dim) → (B, L, J, 3)``."""
        fixed = (self.rigid.rotations, self.rigid.translations, self.log_lengths)
        tensors = (torch.as_tensor(values, dtype=theta.dtype) for values in fixed)
        return self.body.positions(self._decoded_rotations(theta), *tensors)

    @cached_property
    def _double(self) -> MotionVAEModel:
        return copy.deepcopy(self.model).double()

"""`MotionVAE`: a prior over articulated motion with one latent code per sequence (Ponymation).

z ~ N(0, I); bones' rotations ξ = D(z); joints X = FK(ξ). All was learnt from 2D tracks. The rigid
pose, where the body is and how it is turned, is not in the code: it is a path beside it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from probmotion.arrays import Array
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.latent.row_decoding import decode_rows
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.models.training.checkpoints import Checkpoint, save_checkpoint
from probmotion.models.vae.inference import VAEEncoder
from probmotion.models.vae.model import KIND, MotionVAEModel, description_of, read_model
from probmotion.models.vae.network import MotionVAENetwork
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.rigid_paths import RigidPath, see_body
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.protocols import InferenceNetwork, Likelihood
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["KIND", "MotionVAE", "MotionVAEModel", "description_of"]

_ROWS = 64


class MotionVAE(StandardNormalPrior):
    """Motions of an articulated body, as learnt from 2D tracks alone.

    θ is the latent code z, all of it N(0, 1). The rigid path is given: by default the body stands
    at the origin, upright, and looks along +Z, which will do where there is no evidence.
    Evidence is of a body that was placed: with keypoints of a known camera, :meth:`placed_by` puts
    it where the pose network sees it.

    Parameters
    ----------
    network : MotionVAENetwork
        The trained encoder and decoder.
    pose_network : PoseNetwork
        The trained network of rigid poses.
    settings : MotionVAESettings
        Their size.
    body : ArticulatedBody
        The skeleton, its rest pose and what its joints can do.
    fps : float
        Frames per second.
    rigid : RigidPath, optional
        Where the body is, one pose per frame; see above.
    log_lengths : ndarray, (G,), optional
        Logarithms of bones' lengths relative to the rest pose's, one number for a bone and its
        mirror image; 0 by default.
    card : mapping, optional
        What is known of its training.
    inference_network : InferenceNetwork, optional
        What infers motion in this prior; the prior's own encoder by default.

    Raises
    ------
    ValueError
        If a shape disagrees or a number is out of range.
    """

    stand_ins: ClassVar[Mapping[str, str]] = {
        "Denoises2D": "probmotion.models.diffusion.projected_denoiser.denoiser_of makes a prior of "
        "its pictures that is"
    }
    """How to get what the prior lacks, as samplers that need it say when they refuse."""

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
    ) -> None:
        check_positive("fps", fps)
        self.settings = settings
        self.body = body
        self.card = dict(card or {})
        self.rigid = RigidPath.upright(body, settings.frames) if rigid is None else rigid
        self._placed = rigid is not None
        if self.rigid.frames != settings.frames:
            raise ValueError(
                f"rigid has {self.rigid.frames} frames, expected {settings.frames}, as many as a "
                "code's motion"
            )
        self.log_lengths = np.zeros(body.n_groups) if log_lengths is None else log_lengths
        check_shape("log_lengths", self.log_lengths, (body.n_groups,))
        check_finite("log_lengths", self.log_lengths)
        self.inference_network = VAEEncoder() if inference_network is None else inference_network
        self._fps = float(fps)
        self.model = MotionVAEModel(network, pose_network).eval().requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path, **options: Any) -> MotionVAE:
        """Return a trained prior.

        Parameters
        ----------
        source : str or Path
            A checkpoint's file, the folder of a training run, or the name of a prior that comes
            with the package.
        **options
            ``rigid``, ``log_lengths`` and ``inference_network``, as above.

        Raises
        ------
        CheckpointError
            If the file is damaged, of another version or no motion VAE.
        FileNotFoundError
            If there is no such file and no such name.
        """
        found = read_model(source)
        return cls(
            found.model.vae,
            found.model.pose,
            found.settings,
            found.body,
            found.fps,
            card=found.card,
            **options,
        )

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the prior as a checkpoint, which :meth:`load` reads; ``half`` precision if asked.

        The path it is placed on is not in it.

        Raises
        ------
        ValueError
            If the prior has no card to rebuild it by: only trained ones have.
        OSError
            If the file cannot be written.
        """
        if "network" not in self.card:
            raise ValueError("the prior has no card, expected one that was trained or loaded")
        save_checkpoint(path, Checkpoint(KIND, self.card, self.model.state_dict()), half=half)

    def placed(self, rigid: RigidPath, log_lengths: np.ndarray | None = None) -> MotionVAE:
        """Return the same prior on another rigid path, and with other bones where they are given.

        Raises
        ------
        ValueError
            If the path is not as long as the prior's motions.
        """
        return MotionVAE(
            self.model.vae,
            self.model.pose,
            self.settings,
            self.body,
            self._fps,
            rigid=rigid,
            log_lengths=self.log_lengths if log_lengths is None else log_lengths,
            card=self.card,
            inference_network=self.inference_network,
        )

    def placed_by(self, likelihood: Likelihood) -> MotionVAE:
        """Return the same prior where its pose network sees the subject in keypoints of one view.

        The path, and the body's bone lengths, are those of the best view hypothesis
        (:func:`~probmotion.models.vae.rigid_paths.see_body`); the bones' rotations stay the code's.

        Raises
        ------
        ValueError
            If the evidence is no keypoints of one view, of another number of frames, another frame
            rate or other joints, or a whole frame of it is hidden.
        """
        if not isinstance(likelihood, Keypoints2D):
            raise ValueError(
                f"likelihood is {type(likelihood).__name__}, expected Keypoints2D, which the pose "
                "network sees"
            )
        if likelihood.frames != self.frames:
            raise ValueError(
                f"likelihood has {likelihood.frames} frames, expected the prior's {self.frames}"
            )
        fps = likelihood.fps
        if fps is not None and abs(fps - self.fps) > 1e-6 * self.fps:
            raise ValueError(
                f"likelihood is at {fps:g} frames per second, expected the prior's {self.fps:g}"
            )
        seen = see_body(self.model.pose, self.settings, self.body, likelihood)
        return self.placed(seen.path, seen.log_lengths)

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if no one has said where the body is that the evidence is of.

        No code can move or turn the body: of one that stands elsewhere, codes would be bent to
        explain where it is.
        """
        if not self._placed:
            raise ValueError(
                "prior has a body that no one has placed: it stands at the origin and looks along "
                "+Z; expected MotionVAE.placed_by(likelihood), or MotionVAE.placed(path) where its "
                "path is known"
            )

    @property
    def skeleton(self) -> Skeleton:
        """The J joints."""
        return self.body.skeleton

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self.settings.frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._fps

    @property
    def dim(self) -> int:
        """Length Z of θ."""
        return self.settings.latent

    def motion(self, theta: Array) -> Array:
        """Return FK(D(θ)), ``(…, dim) → (…, L, J, 3)``, metres, world Y up; NumPy or torch."""
        shape = (self.frames, self.skeleton.n_joints, 3)
        return decode_rows(self._motion, theta, self.dim, shape, _ROWS)

    def turns(self, theta: Array) -> Array:
        """Return D(θ), ``(…, dim) → (…, L, bones, 3)``: rotation vectors in parents' frames."""
        shape = (self.frames, len(self.body.bones), 3)
        return decode_rows(self._turns, theta, self.dim, shape, _ROWS)

    def row_by_row(self, theta: np.ndarray) -> np.ndarray:
        """Return :meth:`motion`, ``(n, dim) → (n, L, J, 3)``, whose bits are each row's own.

        Rounding depends on the shape of a product: here every batch is of the same shape.
        """
        found = []
        for at in range(0, len(theta), _ROWS):
            some = theta[at : at + _ROWS]
            rows = np.zeros((_ROWS, self.dim), dtype=theta.dtype)
            rows[: len(some)] = some
            found.append(self.motion(rows)[: len(some)])
        return np.concatenate(found)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n motions, (n, L, J, 3), metres; decoded in single precision."""
        return self.row_by_row(self.initial(rng, n).astype(np.float32)).astype(np.float64)

    def _turns(self, theta: torch.Tensor) -> torch.Tensor:
        """Return the turns of rows, ``(B, dim) → (B, L, bones, 3)``."""
        model = self.model if theta.dtype == torch.float32 else self._double
        return model.vae.decode(theta)

    def _motion(self, theta: torch.Tensor) -> torch.Tensor:
        """Return the motions of rows, ``(B, dim) → (B, L, J, 3)``."""

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=theta.dtype)

        return self.body.positions(
            self._turns(theta),
            tensor(self.rigid.rotations),
            tensor(self.rigid.translations),
            tensor(self.log_lengths),
        )

    @cached_property
    def _double(self) -> MotionVAEModel:
        # Densities want double precision, training single.
        return copy.deepcopy(self.model).double()

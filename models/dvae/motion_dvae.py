"""`MotionDVAE`: a dynamical variational auto-encoder of 3D motion, as a prior.

The model is that of Motion-DVAE (supplement, A). Of the prior's coordinates θ every one is a
standard normal number: where the motion stands and looks, the first pose, and what is new in each
frame's latent z_t.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from probmotion.arrays import Array
from probmotion.models.bodies.body_states import BodyStates, check_bones, turned_about_vertical
from probmotion.models.dvae.latent_rollouts import rollout
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.latent.row_decoding import decode_rows
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.models.training.checkpoints import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import InferenceNetwork
from probmotion.validation import check_count, check_positive

__all__ = ["KIND", "MotionDVAE", "description_of"]

KIND = "motion-dvae"

_PLACE = 4
_CHUNK = 256


class MotionDVAE(StandardNormalPrior):
    """What a body does next, learnt from motion capture.

    θ holds, all N(0, 1): the ground position of the first root in units of ``spread`` (2), two
    numbers whose direction is the first heading (2), the first pose along its principal directions
    (r), and ε_t of z_t = μ_z(h_{t−1}) + σ_z(h_{t−1}) ε_t for frames 1 to L − 1.

    Y is up and the floor is at Y = 0, where the bodies that it learnt from stood. Evidence of a
    world whose floor is elsewhere has to be moved there first.

    Parameters
    ----------
    model : DVAEModel
        The trained networks.
    settings : DVAESettings
        Their size.
    states : BodyStates
        How a pose becomes numbers.
    fps : float
        Frames per second.
    frames : int, optional
        L, of the prior's motions; by default that of the windows it learnt. Longer motions are
        walked on beyond them.
    body : ndarray, (J, 3), optional
        Rest offsets of the body that moves, metres; the usual one's by default.
    spread : float
        Standard deviation of where motions stand, metres.
    card : mapping, optional
        What is known of its training.
    inference_network : InferenceNetwork, optional
        What was trained to infer motion in this prior, for samplers that need such a thing; see
        :class:`~probmotion.models.dvae.motion_denoiser.MotionDenoiser`.

    Raises
    ------
    ValueError
        If a shape disagrees or a number is out of range.
    """

    floor = 0.0
    """Y of the floor, metres."""

    def __init__(
        self,
        model: DVAEModel,
        settings: DVAESettings,
        states: BodyStates,
        fps: float,
        *,
        frames: int | None = None,
        body: np.ndarray | None = None,
        spread: float = 3.0,
        card: Mapping[str, Any] | None = None,
        inference_network: InferenceNetwork | None = None,
    ) -> None:
        self.inference_network = inference_network
        self.settings = settings
        self.states = states
        self.card = dict(card or {})
        self.body = states.rest if body is None else np.asarray(body, dtype=np.float64)
        check_bones("body", self.body, states.skeleton)
        self._frames = settings.frames if frames is None else frames
        check_count("frames", self._frames, least=2)
        check_positive("fps", fps)
        check_positive("spread", spread)
        self.spread = spread
        self._fps = float(fps)
        self.model = model.eval().requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path = "body-dvae", **options: Any) -> MotionDVAE:
        """Return a trained prior.

        Parameters
        ----------
        source : str or Path
            A checkpoint's file, the folder of a training run, or the name of a prior that comes
            with the package.
        **options
            ``frames``, ``body`` and ``spread``, as above.

        Raises
        ------
        CheckpointError
            If the file is damaged, of another version or no Motion-DVAE.
        FileNotFoundError
            If there is no such file and no such name.
        """
        checkpoint = load_checkpoint(source, KIND)
        try:
            kept = checkpoint.settings["network"]
            settings = DVAESettings(**kept["size"])
            skeleton = Skeleton(kept["joint_names"], kept["parents"])
            states = BodyStates(skeleton, np.array(kept["rest"]))
            model = DVAEModel(settings, states.dim, skeleton.n_joints, kept["rank"])
            fps = kept["fps"]
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{source} has settings that are no Motion-DVAE's: {error}"
            ) from error
        load_weights(model, checkpoint.tensors)
        return cls(model, settings, states, fps, card=checkpoint.settings, **options)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the prior as a checkpoint, which :meth:`load` reads; ``half`` precision if asked.

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

    def of(
        self,
        *,
        frames: int | None = None,
        body: np.ndarray | None = None,
        inference_network: InferenceNetwork | None = None,
    ) -> MotionDVAE:
        """Return the same prior with motions of another length, another body or a network."""
        return MotionDVAE(
            self.model,
            self.settings,
            self.states,
            self._fps,
            frames=self._frames if frames is None else frames,
            body=self.body if body is None else body,
            spread=self.spread,
            card=self.card,
            inference_network=inference_network or self.inference_network,
        )

    @property
    def skeleton(self) -> Skeleton:
        """The J joints."""
        return self.states.skeleton

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self._frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._fps

    @property
    def rank(self) -> int:
        """Number of directions of the first pose."""
        return int(self.model.initial_factor.shape[1])

    @property
    def dim(self) -> int:
        """Length of θ."""
        return _PLACE + self.rank + (self._frames - 1) * self.settings.latent

    @property
    def joint_scale(self) -> float:
        """Standard deviation of a joint's coordinate about what is decoded, metres: s_x there."""
        return float(torch.exp(self.model.generative.log_scales[-1]))

    def motion(self, theta: Array) -> Array:
        """Return M_β(μ_x) at θ, ``(…, dim) → (…, L, J, 3)``, metres; NumPy or torch, not JAX."""
        shape = (self._frames, self.skeleton.n_joints, 3)
        return decode_rows(self._motion, theta, self.dim, shape, _CHUNK)

    def coordinates(
        self, ground: np.ndarray, heading: np.ndarray, first: np.ndarray, innovations: np.ndarray
    ) -> np.ndarray:
        """Return the θ of motions, up to the length of the heading's two numbers, which is 1.

        Parameters
        ----------
        ground : ndarray, (…, 2)
            X and Z of the first root, metres.
        heading : ndarray, (…)
            Of the first frame, radians.
        first : ndarray, (…, r)
            Coordinates of the first pose.
        innovations : ndarray, (…, L − 1, Z)
            ε.
        """
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        flat = innovations.reshape(*innovations.shape[:-2], -1)
        return np.concatenate([ground / self.spread, direction, first, flat], axis=-1)

    def _motion(self, theta: torch.Tensor) -> torch.Tensor:
        """Return the motions of rows, ``(B, dim) → (B, L, J, 3)``."""
        model = self._model_in(theta.dtype)
        ground = self.spread * theta[:, :2]
        heading = torch.atan2(theta[:, 3], theta[:, 2])
        start = model.first_states(theta[:, _PLACE : _PLACE + self.rank])
        noise = theta[:, _PLACE + self.rank :].unflatten(1, (self._frames - 1, -1))
        rolled = rollout(model.generative, model.standardised(start), noise)
        states = torch.cat([start[:, None], model.decoded(rolled)], dim=1)
        found = turned_about_vertical(self.states.positions(states, self.body), heading)
        moved = torch.stack([ground[:, 0], torch.zeros_like(heading), ground[:, 1]], dim=-1)
        return found + moved[:, None, None, :]

    def _model_in(self, dtype: torch.dtype) -> DVAEModel:
        """Return the networks in a precision: densities want double, training single."""
        return self.model if dtype == torch.float32 else self._double

    @cached_property
    def _double(self) -> DVAEModel:
        return copy.deepcopy(self.model).double()


def description_of(size: DVAESettings, states: BodyStates, fps: float, rank: int) -> dict[str, Any]:
    """Return what a checkpoint says of a Motion-DVAE, as JSON: :meth:`MotionDVAE.load` reads it."""
    return {
        "size": asdict(size),
        "joint_names": list(states.skeleton.joint_names),
        "parents": list(states.skeleton.parents),
        "rest": states.rest.tolist(),
        "fps": fps,
        "rank": rank,
    }

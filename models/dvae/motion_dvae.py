"""`MotionDVAE`: dynamical variational autoencoder prior of 3D motion (Motion-DVAE supplement, A).

The coordinates θ are standard normal: ground position and heading, initial pose, and the
innovations of each frame's latent z_t.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.arrays import Array
from probmotion.extras import torch
from probmotion.models.bodies.body_states import BodyStates, check_bones, turned_about_vertical
from probmotion.models.dvae.latent_rollouts import rollout
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.noisy_windows import on_ground
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.latent.row_decoding import decode_rows
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.models.training.checkpoints import (
    Checkpoint,
    load_checkpoint,
    load_weights,
    save_checkpoint,
    valid_settings,
)
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import InferenceNetwork
from probmotion.validation import check_count, check_positive

__all__ = ["KIND", "MotionDVAE", "description_of"]

KIND = "motion-dvae"

_PLACEMENT_DIM = 4  # Number of coordinates of ground position and heading.
_CHUNK = 256  # Number of motions decoded at once.


class MotionDVAE(StandardNormalPrior):
    """Autoregressive motion prior learnt from motion capture.

    θ ~ N(0, I) contains the initial ground position of the root in units of ``spread`` (2), the
    initial heading as a 2D direction (2), the principal coordinates of the first pose (r), and the
    innovations ε_t of z_t = μ_z(h_{t−1}) + σ_z(h_{t−1}) ε_t for frames 1 to L − 1 and LSTM state h.

    Y is up and the floor is at Y = 0. Transform observations with another floor first.

    Parameters
    ----------
    model : DVAEModel
        Trained networks.
    settings : DVAESettings
        Network size.
    states : BodyStates
        Conversion between poses and state vectors.
    fps : float
        Frames per second.
    frames : int, optional
        Motion length L; by default the training length. Longer motions are extrapolated.
    body : ndarray, (J, 3), optional
        Rest offsets of the body, metres; ``states.rest`` by default.
    spread : float
        Standard deviation of the ground position, metres.
    card : mapping, optional
        Training record.
    inference_network : InferenceNetwork, optional
        Network for amortised inference, such as
        :class:`~probmotion.models.dvae.motion_denoiser.MotionDenoiser`.

    Raises
    ------
    ValueError
        If a shape is invalid or a number is out of range.
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
        self.skeleton = states.skeleton
        self.card = dict(card or {})
        self.body = states.rest if body is None else np.asarray(body, dtype=np.float64)
        check_bones("body", self.body, states.skeleton)
        self.frames = settings.frames if frames is None else frames
        check_count("frames", self.frames, least=2)
        check_positive("fps", fps)
        check_positive("spread", spread)
        self.spread = spread
        self.fps = float(fps)
        self.model = model.eval().requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path = "body-dvae", **options: Any) -> MotionDVAE:
        """Load a trained prior from a checkpoint file, a run folder or a shipped name.

        ``options`` are ``frames``, ``body`` and ``spread`` of :class:`MotionDVAE`. Raises
        ``CheckpointError`` for a damaged file or another kind of network, and ``FileNotFoundError``
        for a missing file.
        """
        checkpoint = load_checkpoint(source, KIND)
        with valid_settings(source, KIND):
            stored = checkpoint.settings["network"]
            settings = DVAESettings(**stored["size"])
            skeleton = Skeleton(stored["joint_names"], stored["parents"])
            states = BodyStates(skeleton, np.array(stored["rest"]))
            model = DVAEModel(settings, states.dim, skeleton.n_joints, stored["rank"])
            fps = stored["fps"]
        load_weights(model, checkpoint.tensors, KIND)
        return cls(model, settings, states, fps, card=checkpoint.settings, **options)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Save the prior as a checkpoint for :meth:`load`, optionally in half precision.

        Raises ``ValueError`` if there is no training record.
        """
        if "network" not in self.card:
            raise ValueError("prior must have a training record to be saved, got none")
        save_checkpoint(path, Checkpoint(KIND, self.card, self.model.state_dict()), half=half)

    def of(
        self,
        *,
        frames: int | None = None,
        body: np.ndarray | None = None,
        inference_network: InferenceNetwork | None = None,
    ) -> MotionDVAE:
        """Return the prior with another motion length, body or inference network."""
        return MotionDVAE(
            self.model,
            self.settings,
            self.states,
            self.fps,
            frames=self.frames if frames is None else frames,
            body=self.body if body is None else body,
            spread=self.spread,
            card=self.card,
            inference_network=inference_network or self.inference_network,
        )

    @property
    def rank(self) -> int:
        """Number of principal directions r of the first pose."""
        return int(self.model.initial_factor.shape[1])

    @property
    def dim(self) -> int:
        """Length of θ."""
        return _PLACEMENT_DIM + self.rank + (self.frames - 1) * self.settings.latent

    @property
    def joint_scale(self) -> float:
        """Decoder standard deviation s_x of a joint coordinate, metres."""
        return float(torch.exp(self.model.generative.log_scales[-1]))

    def motion(self, theta: Array) -> Array:
        """Return the decoded joints at θ, ``(…, dim) → (…, L, J, 3)``, metres; NumPy or torch."""
        shape = (self.frames, self.skeleton.n_joints, 3)
        return decode_rows(self._motion, theta, self.dim, shape, _CHUNK)

    def coordinates(
        self, ground: np.ndarray, heading: np.ndarray, first: np.ndarray, innovations: np.ndarray
    ) -> np.ndarray:
        """Return the coordinates θ of motions, with a unit vector for the heading.

        Arguments are X and Z of the initial root (…, 2), metres, the initial heading (…), radians,
        coordinates of the first pose (…, r) and innovations ε (…, L − 1, Z).
        """
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        flat = innovations.reshape(*innovations.shape[:-2], -1)
        return np.concatenate([ground / self.spread, direction, first, flat], axis=-1)

    def _motion(self, theta: torch.Tensor) -> torch.Tensor:
        """Decode rows, ``(B, dim) → (B, L, J, 3)``."""
        # Densities require double precision.
        model = self.model if theta.dtype == torch.float32 else self._double
        ground = self.spread * theta[:, :2]
        heading = torch.atan2(theta[:, 3], theta[:, 2])
        start = model.first_states(theta[:, _PLACEMENT_DIM : _PLACEMENT_DIM + self.rank])
        noise = theta[:, _PLACEMENT_DIM + self.rank :].unflatten(1, (self.frames - 1, -1))
        rolled = rollout(model.generative, model.standardised(start), noise)
        states = torch.cat([start[:, None], model.decoded(rolled)], dim=1)
        result = turned_about_vertical(self.states.positions(states, self.body), heading)
        return result + on_ground(ground)[:, None, None, :]

    @cached_property
    def _double(self) -> DVAEModel:
        return copy.deepcopy(self.model).double()


def description_of(size: DVAESettings, states: BodyStates, fps: float, rank: int) -> dict[str, Any]:
    """Return the checkpoint settings of a Motion-DVAE, JSON-compatible."""
    return {
        "size": asdict(size),
        "joint_names": list(states.skeleton.joint_names),
        "parents": list(states.skeleton.parents),
        "rest": states.rest.tolist(),
        "fps": fps,
        "rank": rank,
    }

"""`MotionDenoiser`: the inference network of a Motion-DVAE, which reads noisy joints."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from probmotion import seeds
from probmotion.models.dvae.inference import Bound, Denoiser, DenoisingNetworks, Inferred
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.noisy_windows import NoisyWindows, Stitching, windows_of
from probmotion.models.training.checkpoints import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_weights,
    save_checkpoint,
    weights_digest,
)
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.protocols import Likelihood
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_count

__all__ = ["KIND", "MotionDenoiser", "NoisyMotion"]

KIND = "motion-denoiser"

_ROWS = 64
_AVERAGED = 8
_MEANS = 64


class MotionDenoiser:
    """Inference networks of one Motion-DVAE, trained on noisy joints.

    Parameters
    ----------
    networks : DenoisingNetworks
        Trained beside the prior.
    prior : MotionDVAE
        The prior that they infer in.
    card : mapping, optional
        What is known of their training.
    """

    def __init__(
        self, networks: DenoisingNetworks, prior: MotionDVAE, card: Mapping[str, Any] | None = None
    ) -> None:
        self.networks = networks.eval().requires_grad_(False)
        self.prior = prior
        self.card = dict(card or {})

    def __repr__(self) -> str:
        """What it reads and how large it is: what tables and saved draws say of it."""
        numbers = sum(value.numel() for value in self.networks.parameters())
        return f"{type(self).__name__}({self.prior.skeleton.n_joints} joints, {numbers} numbers)"

    @classmethod
    def load(cls, source: str | Path, prior: MotionDVAE) -> MotionDenoiser:
        """Return a trained denoiser of a prior.

        Parameters
        ----------
        source : str or Path
            A checkpoint's file, the folder of a training run, or the name of one in the package.
        prior : MotionDVAE
            The prior that it was trained beside.

        Raises
        ------
        CheckpointError
            If the file is damaged, of another version, no denoiser, or of another prior.
        FileNotFoundError
            If there is no such file and no such name.
        ValueError
            If the prior is no Motion-DVAE.
        """
        _check_kind(prior)
        checkpoint = load_checkpoint(source, KIND)
        try:
            beside = checkpoint.settings["network"]["prior_weights"]
        except (KeyError, TypeError) as error:
            raise CheckpointError(
                f"{source} has settings that are no denoiser's: {error}"
            ) from error
        if beside != weights_digest(prior.model):
            raise CheckpointError(f"{source} is the denoiser of another prior than the one given")
        networks = DenoisingNetworks(prior)
        load_weights(networks, checkpoint.tensors)
        return cls(networks, prior, checkpoint.settings)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the denoiser as a checkpoint, which :meth:`load` reads; halved if asked.

        Raises
        ------
        ValueError
            If it has no card to rebuild it by: only trained ones have.
        OSError
            If the file cannot be written.
        """
        if "network" not in self.card:
            raise ValueError("the denoiser has no card, expected one that was trained or loaded")
        save_checkpoint(path, Checkpoint(KIND, self.card, self.networks.state_dict()), half=half)

    def reads(self, likelihood: Likelihood | None) -> bool:
        """Whether the networks can read some evidence: noisy 3D joints."""
        return isinstance(likelihood, Joints3D)

    def on(
        self,
        prior: MotionDVAE,
        likelihood: Joints3D,
        *,
        degrees_of_freedom: float | None = None,
        overlap: int = 10,
    ) -> NoisyMotion:
        """Return the inference of one recording, with networks of its own.

        Parameters
        ----------
        prior : MotionDVAE
            The posterior's prior: this denoiser's, of any length and body.
        likelihood : Joints3D
            The evidence.
        degrees_of_freedom : float, optional
            λ of the noise that is supposed; ``inf`` for Gaussian. By default the evidence's own.
        overlap : int
            Frames that windows share, one less than a window has at most.

        Raises
        ------
        ValueError
            If the prior is another one, a whole window is hidden, or ``overlap`` is out of range.
        """
        _check_kind(prior)
        same = prior.model is self.prior.model
        if not same and weights_digest(prior.model) != weights_digest(self.prior.model):
            raise ValueError("prior is another one than the denoiser was trained beside")
        own = likelihood.entries.degrees_of_freedom
        freedom = own if degrees_of_freedom is None else degrees_of_freedom
        tails = 0.0 if freedom is None or math.isinf(freedom) else 1 / freedom
        window = self.prior.settings.frames
        check_count("overlap", overlap, least=0)
        if overlap >= window:
            raise ValueError(
                f"overlap is {overlap}, expected less than the {window} frames of a window of the "
                "denoiser's"
            )
        stitching = Stitching(likelihood.frames, window, overlap)
        windows = windows_of(likelihood, prior.body, prior.skeleton, stitching, tails)
        return NoisyMotion(Denoiser(prior, copy.deepcopy(self.networks)), windows, stitching)


class NoisyMotion:
    """One recording with the networks that infer what moved, which may be fitted to it alone.

    Parameters
    ----------
    denoiser : Denoiser
        Prior and networks.
    windows : NoisyWindows
        The recording's.
    stitching : Stitching
        How they lie.
    """

    def __init__(self, denoiser: Denoiser, windows: NoisyWindows, stitching: Stitching) -> None:
        self.denoiser = denoiser
        self.windows = windows
        self.stitching = stitching

    def parameters(self) -> list[torch.nn.Parameter]:
        """Return what may be fitted, from now on with gradients."""
        self.denoiser.networks.requires_grad_(True)
        return list(self.denoiser.networks.parameters())

    def bound(self, rng: np.random.Generator, *, initial_entropy: bool = True) -> Bound:
        """Return the evidence lower bound's parts at one draw per window, (B,) each."""
        inferred = self.denoiser.infer(self.windows, *self._numbers(rng, 1))
        return self.denoiser.bound(self.windows, inferred, first=initial_entropy)

    def loss(
        self, rng: np.random.Generator, *, initial_entropy: bool, latent_weight: float
    ) -> torch.Tensor:
        """Return minus the bound, summed over windows, at one draw."""
        return -self.bound(rng, initial_entropy=initial_entropy).total(latent_weight).sum()

    def draw(self, streams: RandomNumbers, n: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return draws of the motion, (n, L, J, 3), metres, and θ where it is one window."""
        count = len(self.windows)
        first, shape = self.denoiser.noise_numbers(self.stitching.length)
        drawn = streams.standard_normal((n, count, first + math.prod(shape)))
        positions, thetas = [], []
        # Rounding depends on the shape of a product, and draws must not depend on their batch.
        whole = max(1, _ROWS // count)
        for at in range(0, n, whole):
            rows = np.zeros((whole, *drawn.shape[1:]), dtype=np.float32)
            some = drawn[at : at + whole]
            rows[: len(some)] = some
            inferred = self._inferred_from(rows)
            positions.append(self._apart(inferred.positions)[: len(some)])
            if count == 1:
                thetas.append(self._theta(inferred)[: len(some)])
        windows = np.concatenate(positions)
        if count == 1:
            theta = np.concatenate(thetas)
            # The heading's two numbers have a length too, of which nothing is known.
            length = np.linalg.norm(streams.standard_normal((n, 2)), axis=-1, keepdims=True)
            theta[:, 2:4] *= length
            return windows[:, 0], theta
        return self.stitching.draws(windows, self._mean_of_windows()), None

    @torch.no_grad()
    def predict(self, rng: np.random.Generator, *, average: bool = True) -> np.ndarray:
        """Return the motion predicted, (L, J, 3), metres (D, equation 11).

        The mean over draws of what lies between observation and decoded joint by their variances;
        of the decoded joint where nothing was observed. Frame 0 is M_β(μ_ω).

        Parameters
        ----------
        rng : numpy.random.Generator
            Of the draws.
        average : bool
            Average over draws; else decode the means of q, once ("NN output").
        """
        begun = self._apart(self._inferred_from(self._still(1)).positions)[0]
        if not average:
            return self.stitching.mean(begun)
        inferred = self.denoiser.infer(
            self.windows.repeated(_AVERAGED), *self._numbers(rng, _AVERAGED)
        )
        square = self.denoiser.prior.joint_scale**2
        windows = self.windows.repeated(_AVERAGED)
        v = self.denoiser.drawn_variance(windows, inferred, rng)
        between = (v * inferred.positions + square * windows.joints) / (v + square)
        seen = windows.seen[..., None]
        mean = self._apart(torch.where(seen, between, inferred.positions)).mean(axis=0)
        mean[:, 0] = begun[:, 0]
        return self.stitching.mean(mean)

    def _numbers(self, rng: np.random.Generator, n: int) -> tuple[torch.Tensor, torch.Tensor]:
        rows = n * len(self.windows)
        first, shape = self.denoiser.noise_numbers(self.stitching.length)
        return (
            torch.as_tensor(rng.standard_normal((rows, first), dtype=np.float32)),
            torch.as_tensor(rng.standard_normal((rows, *shape), dtype=np.float32)),
        )

    def _still(self, n: int) -> np.ndarray:
        first, shape = self.denoiser.noise_numbers(self.stitching.length)
        return np.zeros((n, len(self.windows), first + math.prod(shape)), dtype=np.float32)

    def _inferred_from(self, numbers: np.ndarray) -> Inferred:
        """Return draws from numbers (n, B, …), n copies of all windows, without gradients."""
        first, shape = self.denoiser.noise_numbers(self.stitching.length)
        flat = torch.as_tensor(numbers).flatten(0, 1)
        windows = self.windows.repeated(len(numbers))
        with torch.no_grad():
            return self.denoiser.infer(
                windows, flat[:, :first], flat[:, first:].unflatten(1, shape)
            )

    def _apart(self, positions: torch.Tensor) -> np.ndarray:
        """Return (n B, …) as (n, B, …), double precision."""
        found = positions.detach().double().numpy()
        return found.reshape(-1, len(self.windows), *found.shape[1:])

    def _mean_of_windows(self) -> np.ndarray:
        with torch.no_grad():
            numbers = self._numbers(seeds.generator(0, "means of windows"), _MEANS)
            inferred = self.denoiser.infer(self.windows.repeated(_MEANS), *numbers)
        return self._apart(inferred.positions).mean(axis=0)

    def _theta(self, inferred: Inferred) -> np.ndarray:
        parts = (inferred.ground, inferred.heading, inferred.first, inferred.rolled.innovations)
        return self.denoiser.prior.coordinates(*(part.double().numpy() for part in parts))


def _check_kind(prior: Any) -> None:
    if not isinstance(prior, MotionDVAE):
        raise ValueError(
            f"prior is {type(prior).__name__}, expected the Motion-DVAE that the denoiser was "
            "trained beside"
        )

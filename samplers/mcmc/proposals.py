"""Proposal distributions of Metropolis-Hastings.

A proposal is a frozen dataclass of settings. Its adaptive state is a dictionary of arrays whose
first axis is the chain. Guided proposals also use the guide of a point, (chains, dim): the mean
squared speed of each coordinate in the closest annotations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from probmotion.validation import check_positive

__all__ = ["AdaptiveCovariance", "Isotropic", "Proposal", "ProposalState", "VelocityBiased"]

Generators = Sequence[np.random.Generator]
"""One generator per chain."""

ProposalState = Mapping[str, np.ndarray]
"""Arrays whose first axis is the chain."""


class Proposal(Protocol):
    """Proposal distribution q(θ' | θ) with adaptation during warm-up."""

    guided: ClassVar[bool]
    """Whether the proposal uses the guide."""

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return the state of chains that start at ``theta``, (chains, dim)."""

    def propose(
        self, generators: Generators, theta: np.ndarray, guide: np.ndarray, state: ProposalState
    ) -> np.ndarray:
        """Return the proposed points θ', (chains, dim), from the current points ``theta``.

        ``guide`` is (chains, dim), or (chains, 0) if the proposal is not guided.
        """

    def log_ratio(
        self,
        theta: np.ndarray,
        guide: np.ndarray,
        proposed: np.ndarray,
        proposed_guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return log q(θ | θ') − log q(θ' | θ), (chains,)."""

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state adapted to ``theta`` and ``acceptance``, (chains,), during warm-up."""

    def settled(self, state: ProposalState) -> ProposalState:
        """Return the state required after warm-up, without adaptation statistics."""


class _Symmetric:
    """Base class of symmetric proposals."""

    guided: ClassVar[bool] = False

    def log_ratio(
        self,
        theta: np.ndarray,
        guide: np.ndarray,
        proposed: np.ndarray,
        proposed_guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return zeros, because the proposal is symmetric."""
        return np.zeros(len(theta))


class _AdaptiveScale:
    """Base class of proposals that adapt only their scale s."""

    scale: float
    target: float | None

    def __post_init__(self) -> None:
        check_positive("scale", self.scale)
        if self.target is not None:
            _check_target(self.target)

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return log s and the number of adaptation steps."""
        chains = len(theta)
        return {"log_scale": np.full(chains, math.log(self.scale)), "steps": np.zeros(chains)}

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state with s adapted towards the target acceptance rate."""
        if self.target is None:
            return state
        steps = state["steps"] + 1
        log_scale = _adapted(state["log_scale"], acceptance - self.target, steps)
        return {"log_scale": log_scale, "steps": steps}

    def settled(self, state: ProposalState) -> ProposalState:
        """Return log s."""
        return {"log_scale": state["log_scale"]}


@dataclass(frozen=True)
class Isotropic(_AdaptiveScale, _Symmetric):
    """Random-walk proposal θ' = θ + s ε, ε ~ N(0, I) (Metropolis et al. 1953).

    Parameters
    ----------
    scale : float
        Initial scale s, in units of θ.
    target : float or None
        Target acceptance rate for adapting s; ``None`` disables adaptation.
    """

    kind: str = field(default="isotropic", init=False)
    scale: float = 0.1
    target: float | None = 0.234

    def propose(
        self, generators: Generators, theta: np.ndarray, guide: np.ndarray, state: ProposalState
    ) -> np.ndarray:
        """Return θ + s ε."""
        return theta + np.exp(state["log_scale"])[:, None] * _normal(generators, theta.shape[1])


@dataclass(frozen=True)
class AdaptiveCovariance(_Symmetric):
    """Random-walk proposal θ' = θ + s C ε with warm-up covariance C Cᵀ (Haario et al. 2001).

    Warm-up is divided into windows of 50, 100, 200, … steps. At the end of each window, C is set to
    the Cholesky factor of the regularised covariance of the window and s to 2.38/√dim (Gelman et
    al. 1996). Within windows, s is adapted towards the target acceptance rate (Andrieu and Thoms
    2008, algorithm 4).

    Parameters
    ----------
    scale : float
        Scale s in the first window, where C = I, in units of θ.
    target : float
        Target acceptance rate.
    """

    kind: str = field(default="adaptive-covariance", init=False)
    scale: float = 0.1
    target: float = 0.234

    def __post_init__(self) -> None:
        check_positive("scale", self.scale)
        _check_target(self.target)

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return log s, C and the running moments of the window."""
        chains, dim = theta.shape
        return {
            "log_scale": np.full(chains, math.log(self.scale)),
            "root": np.tile(np.eye(dim), (chains, 1, 1)),
            "window": np.full(chains, float(_FIRST_WINDOW)),
            "steps": np.zeros(chains),
            "mean": np.zeros((chains, dim)),
            "scatter": np.zeros((chains, dim, dim)),
        }

    def propose(
        self, generators: Generators, theta: np.ndarray, guide: np.ndarray, state: ProposalState
    ) -> np.ndarray:
        """Return θ + s C ε."""
        step = (state["root"] @ _normal(generators, theta.shape[1])[..., None])[..., 0]
        return theta + np.exp(state["log_scale"])[:, None] * step

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state with s and the moments updated and, at the end of a window, C."""
        steps = state["steps"] + 1
        difference = theta - state["mean"]
        mean = state["mean"] + difference / steps[:, None]
        scatter = state["scatter"] + difference[:, :, None] * (theta - mean)[:, None, :]
        learnt = {
            **state,
            "log_scale": _adapted(state["log_scale"], acceptance - self.target, steps),
            "steps": steps,
            "mean": mean,
            "scatter": scatter,
        }
        # The windows of all chains end at the same step.
        if steps[0] < state["window"][0]:
            return learnt
        chains, dim = theta.shape
        return {
            **self.begin(theta),
            "log_scale": np.full(chains, math.log(2.38 / math.sqrt(dim))),
            "root": np.linalg.cholesky(_shrunk(scatter, steps[0])),
            "window": 2 * state["window"],
        }

    def settled(self, state: ProposalState) -> ProposalState:
        """Return log s and C."""
        return {"log_scale": state["log_scale"], "root": state["root"]}


@dataclass(frozen=True)
class VelocityBiased(_AdaptiveScale):
    """Proposal N(θ, s² diag σ²(θ)), which is wider along fast coordinates (Yin et al. 2018).

    Variances are σ²(θ) = σ₀² + b V(θ), with b = 1 in eq. 12. The guide V(θ) is the mean squared
    speed of each coordinate in the annotations closest to θ, so the proposal is not symmetric.

    Parameters
    ----------
    scale : float
        Initial scale s.
    base : float
        Proposal scale σ₀ at zero speed, in units of θ.
    bias : float
        Weight b of the mean squared speeds.
    target : float or None
        Target acceptance rate for adapting s; ``None`` disables adaptation.
    """

    guided: ClassVar[bool] = True

    kind: str = field(default="velocity-biased", init=False)
    scale: float = 1.0
    base: float = 0.05
    bias: float = 1.0
    target: float | None = 0.234

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("base", self.base)
        check_positive("bias", self.bias)

    def propose(
        self, generators: Generators, theta: np.ndarray, guide: np.ndarray, state: ProposalState
    ) -> np.ndarray:
        """Return θ + s σ(θ) ε."""
        return theta + np.sqrt(self._variances(guide, state)) * _normal(generators, theta.shape[1])

    def log_ratio(
        self,
        theta: np.ndarray,
        guide: np.ndarray,
        proposed: np.ndarray,
        proposed_guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return log N(θ; θ', s² σ²(θ')) − log N(θ'; θ, s² σ²(θ)), (chains,)."""
        forward, backward = (self._variances(g, state) for g in (guide, proposed_guide))
        square = (proposed - theta) ** 2
        terms = np.log(forward / backward) + square / forward - square / backward
        return 0.5 * terms.sum(axis=1)

    def _variances(self, guide: np.ndarray, state: ProposalState) -> np.ndarray:
        s = np.exp(state["log_scale"])[:, None]
        return s**2 * (self.base**2 + self.bias * guide)


_FIRST_WINDOW = 50  # Number of warm-up steps in the first window.


def _shrunk(scatter: np.ndarray, n: float) -> np.ndarray:
    """Return a positive definite covariance from n points, regularised as in Stan."""
    dim = scatter.shape[-1]
    variance = np.trace(scatter, axis1=-2, axis2=-1) / (n * dim)
    # The lower bound applies to chains that have not moved.
    floor = np.maximum(1e-3 * variance, 1e-12)
    return (scatter + 5 * floor[:, None, None] * np.eye(dim)) / (n + 5)


def _adapted(log_scale: np.ndarray, surplus: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return log s after one Robbins-Monro step of size n^(−0.6), with n = ``steps``."""
    return log_scale + surplus * steps**-0.6


def _normal(generators: Sequence[np.random.Generator], dim: int) -> np.ndarray:
    out = np.empty((len(generators), dim))
    for row, rng in zip(out, generators, strict=True):
        rng.standard_normal(out=row)
    return out


def _check_target(target: float) -> None:
    if not (isinstance(target, int | float) and 0 < target < 1):
        raise ValueError(f"target must be between 0 and 1, got {target!r}")

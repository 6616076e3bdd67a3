"""Proposals of Metropolis-Hastings: where a chain might go next.

A proposal is a frozen object of settings. What it remembers of each chain is a state: a dictionary
of arrays whose first axis is the chain, so that it can be saved and chains never share anything.
What the posterior says at a point beside its density is the point's guide: how far the evidence
moves each coordinate, (chains, dim), for proposals that are ``guided``; of no width for others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from probmotion.validation import check_positive

__all__ = ["AdaptiveCovariance", "Isotropic", "Proposal", "ProposalState", "VelocityBiased"]

ProposalState = Mapping[str, np.ndarray]
"""Arrays whose first axis is the chain."""


class Proposal(Protocol):
    """How chains propose, and what they learn from the answers during warm-up."""

    guided: ClassVar[bool]
    """Whether proposing needs the guide."""

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return the state of chains that start at ``theta``, (chains, dim)."""

    def propose(
        self,
        generators: Sequence[np.random.Generator],
        theta: np.ndarray,
        guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return the proposed points θ', (chains, dim).

        Parameters
        ----------
        generators : sequence of numpy.random.Generator
            One per chain; chain k draws from the k-th alone.
        theta : ndarray, (chains, dim)
            Where the chains are.
        guide : ndarray, (chains, dim) or (chains, 0)
            The guide there.
        state : ProposalState
            What the proposal knows of each chain.
        """

    def log_ratio(
        self,
        theta: np.ndarray,
        guide: np.ndarray,
        proposed: np.ndarray,
        proposed_guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return log q(θ | θ') − log q(θ' | θ), (chains,); 0 for a symmetric proposal."""

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state after a step of the warm-up, the only time it may change.

        Parameters
        ----------
        state : ProposalState
            The state that the step was proposed with.
        theta : ndarray, (chains, dim)
            Where the chains are after the step.
        acceptance : ndarray, (chains,)
            The step's probability of acceptance.
        """

    def settled(self, state: ProposalState) -> ProposalState:
        """Return what proposing needs of a state once the warm-up is over."""


class _Symmetric:
    """What proposals share that go from one point to another as often as back."""

    guided: ClassVar[bool] = False

    def log_ratio(
        self,
        theta: np.ndarray,
        guide: np.ndarray,
        proposed: np.ndarray,
        proposed_guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return 0: the proposal is symmetric."""
        return np.zeros(len(theta))


@dataclass(frozen=True)
class Isotropic(_Symmetric):
    """θ' = θ + s ε, ε ~ N(0, I): the random walk of Metropolis et al. (1953).

    Parameters
    ----------
    scale : float
        s, in units of θ; where the warm-up begins.
    target : float or None
        Acceptance that the warm-up steers each chain's s towards; ``None`` keeps ``scale``.
    """

    kind: str = field(default="isotropic", init=False)
    scale: float = 0.1
    target: float | None = 0.234

    def __post_init__(self) -> None:
        check_positive("scale", self.scale)
        if self.target is not None:
            _check_target(self.target)

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return s and the number of steps learnt from."""
        chains = len(theta)
        return {"log_scale": np.full(chains, math.log(self.scale)), "steps": np.zeros(chains)}

    def propose(
        self,
        generators: Sequence[np.random.Generator],
        theta: np.ndarray,
        guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return θ + s ε."""
        return theta + np.exp(state["log_scale"])[:, None] * _normal(generators, theta.shape[1])

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state with s moved towards the target."""
        if self.target is None:
            return state
        steps = state["steps"] + 1
        moved = _steered(state["log_scale"], acceptance - self.target, steps)
        return {"log_scale": moved, "steps": steps}

    def settled(self, state: ProposalState) -> ProposalState:
        """Return s."""
        return {"log_scale": state["log_scale"]}


@dataclass(frozen=True)
class AdaptiveCovariance(_Symmetric):
    """θ' = θ + s C ε, C Cᵀ the covariance of the chain's own warm-up (Haario et al. 2001).

    The warm-up is cut into windows of 50, 100, 200, … steps. At the end of each the covariance of
    its points, shrunk towards a multiple of I, replaces C; s then begins at 2.38/√dim (Gelman et
    al. 1996) and is steered towards the target acceptance (Andrieu and Thoms 2008, algorithm 4).
    After the warm-up neither changes.

    Parameters
    ----------
    scale : float
        s C before the first window has ended, a multiple of I, in units of θ.
    target : float
        Acceptance that each chain's s is steered towards.
    """

    kind: str = field(default="adaptive-covariance", init=False)
    scale: float = 0.1
    target: float = 0.234

    def __post_init__(self) -> None:
        check_positive("scale", self.scale)
        _check_target(self.target)

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return s, C and the running sums of the window."""
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
        self,
        generators: Sequence[np.random.Generator],
        theta: np.ndarray,
        guide: np.ndarray,
        state: ProposalState,
    ) -> np.ndarray:
        """Return θ + s C ε."""
        step = (state["root"] @ _normal(generators, theta.shape[1])[..., None])[..., 0]
        return theta + np.exp(state["log_scale"])[:, None] * step

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state with s moved, the window's sums grown and, at its end, C replaced."""
        steps = state["steps"] + 1
        apart = theta - state["mean"]
        mean = state["mean"] + apart / steps[:, None]
        scatter = state["scatter"] + apart[:, :, None] * (theta - mean)[:, None, :]
        learnt = {
            **state,
            "log_scale": _steered(state["log_scale"], acceptance - self.target, steps),
            "steps": steps,
            "mean": mean,
            "scatter": scatter,
        }
        # All chains warm up in step, so that their windows end together.
        if steps[0] < state["window"][0]:
            return learnt
        chains, dim = theta.shape
        fresh = self.begin(theta)
        return {
            **fresh,
            "log_scale": np.full(chains, math.log(2.38 / math.sqrt(dim))),
            "root": np.linalg.cholesky(_shrunk(scatter, steps[0])),
            "window": 2 * state["window"],
        }

    def settled(self, state: ProposalState) -> ProposalState:
        """Return s and C."""
        return {"log_scale": state["log_scale"], "root": state["root"]}


@dataclass(frozen=True)
class VelocityBiased:
    """θ' ~ N(θ, s² diag(σ₀² + b V(θ))): longer steps where the evidence moves (Yin et al. 2018).

    V(θ), the guide, is the mean squared step of each coordinate in the annotations that are
    closest to θ (eq. 12, with b = 1). It differs from point to point, so that the ratio of
    proposal densities does not cancel.

    Parameters
    ----------
    scale : float
        s; where the warm-up begins.
    base : float
        σ₀, in units of θ.
    bias : float
        b, the weight of the velocities.
    target : float or None
        Acceptance that the warm-up steers each chain's s towards; ``None`` keeps ``scale``.
    """

    guided: ClassVar[bool] = True

    kind: str = field(default="velocity-biased", init=False)
    scale: float = 1.0
    base: float = 0.05
    bias: float = 1.0
    target: float | None = 0.234

    def __post_init__(self) -> None:
        for name in ("scale", "base", "bias"):
            check_positive(name, getattr(self, name))
        if self.target is not None:
            _check_target(self.target)

    def begin(self, theta: np.ndarray) -> ProposalState:
        """Return s and the number of steps learnt from."""
        return Isotropic(self.scale, self.target).begin(theta)

    def propose(
        self,
        generators: Sequence[np.random.Generator],
        theta: np.ndarray,
        guide: np.ndarray,
        state: ProposalState,
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
        """Return log N(θ; θ', σ²(θ')) − log N(θ'; θ, σ²(θ))."""
        there, back = self._variances(guide, state), self._variances(proposed_guide, state)
        square = (proposed - theta) ** 2
        return 0.5 * (np.log(there / back) + square / there - square / back).sum(axis=1)

    def learn(
        self, state: ProposalState, theta: np.ndarray, acceptance: np.ndarray
    ) -> ProposalState:
        """Return the state with s moved towards the target."""
        return Isotropic(self.scale, self.target).learn(state, theta, acceptance)

    def settled(self, state: ProposalState) -> ProposalState:
        """Return s."""
        return {"log_scale": state["log_scale"]}

    def _variances(self, guide: np.ndarray, state: ProposalState) -> np.ndarray:
        s = np.exp(state["log_scale"])[:, None]
        return s**2 * (self.base**2 + self.bias * guide)


_FIRST_WINDOW = 50


def _shrunk(scatter: np.ndarray, n: float) -> np.ndarray:
    """Return a covariance from n points that is positive definite: ``(chains, dim, dim)``.

    The weight of five points on a small multiple of I, as in Stan.
    """
    dim = scatter.shape[-1]
    variance = np.trace(scatter, axis1=-2, axis2=-1) / (n * dim)
    # A chain that has not moved has no scale of its own.
    floor = np.maximum(1e-3 * variance, 1e-12)
    return (scatter + 5 * floor[:, None, None] * np.eye(dim)) / (n + 5)


def _steered(log_scale: np.ndarray, surplus: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return log s after one Robbins-Monro step of size n^(−0.6)."""
    return log_scale + surplus * steps**-0.6


def _normal(generators: Sequence[np.random.Generator], dim: int) -> np.ndarray:
    out = np.empty((len(generators), dim))
    for row, rng in zip(out, generators, strict=True):
        rng.standard_normal(out=row)
    return out


def _check_target(target: float) -> None:
    if not (isinstance(target, int | float) and 0 < target < 1):
        raise ValueError(f"target must be an acceptance between 0 and 1, got {target!r}")

"""The numbers by which a truth is ranked among draws, and the credible sets that they belong to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import to_numpy
from probmotion.metrics.credible_sets import DENSITY
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem

__all__ = ["Quantity", "log_densities", "quantities"]

_DIRECTIONS = 3


@dataclass(frozen=True, eq=False)
class Quantity:
    """One number of a motion: ``evaluate`` is (n, L, J, 3), metres, → (n,)."""

    name: str
    evaluate: Callable[[np.ndarray], np.ndarray]


def quantities(posterior: MotionPosterior, seed: int = 0) -> list[Quantity]:
    """Return what is ranked of every motion of a posterior: the same for all samplers and draws.

    - ``direction 1`` to ``3``: coordinates of the motion about its root along random directions
    - ``height of <joint>``: of a random joint in a random frame, metres
    - ``hidden <joint>``: the same of a joint that the evidence does not see, along a random
      direction about its root; only where some are hidden
    - ``speed``: mean over joints and frames of the length of a step, metres; of several frames only

    Parameters
    ----------
    posterior : MotionPosterior
        Of the problem itself, not of a simulation.
    seed : int
        Seed of the choice.
    """
    rng = seeds.generator(seed, "quantities")
    shape = (posterior.frames, posterior.skeleton.n_joints, 3)
    root = posterior.skeleton.roots[0]
    found = []
    for k in range(_DIRECTIONS):
        direction = rng.standard_normal(shape)
        direction /= np.sqrt((direction**2).sum())
        found.append(Quantity(f"direction {k + 1}", partial(_along, direction, root)))
    frame, joint = int(rng.integers(shape[0])), _other_than(rng, root, shape[1])
    name = posterior.skeleton.joint_names[joint]
    found.append(Quantity(f"height of {name}", partial(_height, frame, joint)))
    unseen = _hidden(posterior)
    direction = rng.standard_normal(3)
    if unseen is not None and len(unseen):
        frame, joint = (int(index) for index in unseen[rng.integers(len(unseen))])
        at = np.zeros(shape)
        at[frame, joint] = direction / np.sqrt((direction**2).sum())
        name = posterior.skeleton.joint_names[joint]
        found.append(Quantity(f"hidden {name}", partial(_along, at, root)))
    if posterior.frames > 1:
        found.append(Quantity("speed", _speed))
    return found


def log_densities(simulation: Problem, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``log likelihood`` and ``log density`` of motions, as far as there are such.

    A quantity that depends on the evidence finds what coordinates do not: draws from the prior
    rank the truth uniformly in every coordinate (Modrák et al. 2023, "Simulation-based calibration
    checking for Bayesian computation: the choice of test quantities shapes sensitivity"). The
    density is the posterior's up to a constant, over positions.

    Parameters
    ----------
    simulation : Problem
        With the evidence that was simulated.
    positions : ndarray, (n, L, J, 3)
        Metres.
    """
    found: dict[str, np.ndarray] = {}
    likelihood = simulation.posterior.likelihood
    if likelihood is not None:
        found["log likelihood"] = to_numpy(likelihood.log_density(positions))
    density = simulation.log_density_of(positions)
    if density is not None:
        found[DENSITY] = density
    return found


def _along(direction: np.ndarray, root: int, positions: np.ndarray) -> np.ndarray:
    about_root = positions - positions[:, :, root : root + 1]
    return np.einsum("nljc,ljc->n", about_root, direction)


def _height(frame: int, joint: int, positions: np.ndarray) -> np.ndarray:
    return positions[:, frame, joint, 1]


def _speed(positions: np.ndarray) -> np.ndarray:
    steps = np.diff(positions, axis=1)
    return np.sqrt((steps**2).sum(axis=-1)).mean(axis=(1, 2))


def _other_than(rng: np.random.Generator, root: int, n_joints: int) -> int:
    others = [joint for joint in range(n_joints) if joint != root] or [root]
    return int(rng.choice(others))


def _hidden(posterior: MotionPosterior) -> np.ndarray | None:
    """Frames and joints that no view saw, (n, 2); None where the evidence does not say."""
    entries: Any = getattr(posterior.likelihood, "entries", None)
    if entries is None:
        return None
    seen = entries.visible.reshape(-1, *entries.visible.shape[-2:]).any(axis=0)
    return np.argwhere(~seen)

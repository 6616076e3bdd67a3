"""Scalar quantities of motions in which the truth is ranked among draws."""

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
    """A scalar quantity of motions; ``evaluate`` maps (n, L, J, 3), metres, to (n,)."""

    name: str
    evaluate: Callable[[np.ndarray], np.ndarray]


def quantities(posterior: MotionPosterior, seed: int = 0) -> list[Quantity]:
    """Return the quantities of a posterior's motions, the same for all samplers and draws.

    - ``direction 1`` to ``3``: root-relative motion projected on random directions
    - ``height of <joint>``: of a random joint in a random frame, metres
    - ``hidden <joint>``: a random occluded joint, if any, along a random direction
    - ``speed``: mean step length over joints and frames, metres, for several frames

    Parameters
    ----------
    posterior : MotionPosterior
        Posterior of the problem, not of a simulation.
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
    occluded = _occluded(posterior)
    direction = rng.standard_normal(3)
    if len(occluded):
        frame, joint = (int(index) for index in occluded[rng.integers(len(occluded))])
        at = np.zeros(shape)
        at[frame, joint] = direction / np.sqrt((direction**2).sum())
        name = posterior.skeleton.joint_names[joint]
        found.append(Quantity(f"hidden {name}", partial(_along, at, root)))
    if posterior.frames > 1:
        found.append(Quantity("speed", _speed))
    return found


def log_densities(simulation: Problem, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``log likelihood`` and ``log density`` of motions, if defined.

    Quantities that depend on the observations detect errors that coordinates miss, such as draws
    from the prior (Modrák et al. 2023, "Simulation-based calibration checking for Bayesian
    computation: the choice of test quantities shapes sensitivity").

    Parameters
    ----------
    simulation : Problem
        Problem with simulated observations.
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


def _occluded(posterior: MotionPosterior) -> np.ndarray:
    """Return frames and joints observed in no view, (n, 2); empty if unknown."""
    entries: Any = getattr(posterior.likelihood, "entries", None)
    if entries is None:
        return np.zeros((0, 2), dtype=int)
    seen = entries.visible.reshape(-1, *entries.visible.shape[-2:]).any(axis=0)
    return np.argwhere(~seen)

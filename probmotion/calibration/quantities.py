"""Scalar quantities of motions for ranking the truth among draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from probmotion import seeds
from probmotion.arrays import to_numpy
from probmotion.metrics.measures import visible_joints
from probmotion.metrics.uniformity import DENSITY
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem

__all__ = ["Quantity", "log_densities", "quantities"]

_DIRECTIONS = 3  # number of random directions


@dataclass(frozen=True, eq=False)
class Quantity:
    """Scalar quantity of motions; ``evaluate`` maps (n, L, J, 3), metres, to (n,)."""

    name: str
    evaluate: Callable[[np.ndarray], np.ndarray]


def quantities(posterior: MotionPosterior, seed: int = 0) -> list[Quantity]:
    """Return the quantities of a posterior's motions, the same for all samplers and draws.

    - ``direction 1`` to ``3``: root-relative motion projected on random directions
    - ``height of <joint>``: height of a random joint in a random frame, metres
    - ``hidden <joint>``: root-relative coordinate of an occluded joint, if any, on a random axis
    - ``speed``: mean displacement of joints between frames, metres, if there are several frames

    ``posterior`` belongs to the problem, not to a simulation; ``seed`` determines random choices.
    """
    rng = seeds.generator(seed, "quantities")
    shape = (posterior.frames, posterior.skeleton.n_joints, 3)
    root = posterior.skeleton.roots[0]
    chosen = []
    for k in range(_DIRECTIONS):
        direction = rng.standard_normal(shape)
        direction /= np.sqrt((direction**2).sum())
        chosen.append(Quantity(f"direction {k + 1}", partial(_along, direction, root)))
    joints = [joint for joint in range(shape[1]) if joint != root] or [root]
    frame, joint = int(rng.integers(shape[0])), int(rng.choice(joints))
    name = posterior.skeleton.joint_names[joint]
    chosen.append(Quantity(f"height of {name}", partial(_height, frame, joint)))
    visible = visible_joints(posterior)
    direction = rng.standard_normal(3)
    if visible is not None and not visible.all():
        occluded = np.argwhere(~visible)
        frame, joint = (int(index) for index in occluded[rng.integers(len(occluded))])
        weights = np.zeros(shape)
        weights[frame, joint] = direction / np.sqrt((direction**2).sum())
        name = posterior.skeleton.joint_names[joint]
        chosen.append(Quantity(f"hidden {name}", partial(_along, weights, root)))
    if posterior.frames > 1:
        chosen.append(Quantity("speed", _speed))
    return chosen


def log_densities(simulation: Problem, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``log likelihood`` and ``log density`` of motions, (n, L, J, 3) → (n,), if defined.

    Quantities that depend on the simulated observations detect errors that coordinates miss, such
    as draws from the prior (Modrák et al. 2023, "Simulation-based calibration checking for Bayesian
    computation: the choice of test quantities shapes sensitivity").
    """
    values: dict[str, np.ndarray] = {}
    likelihood = simulation.posterior.likelihood
    if likelihood is not None:
        values["log likelihood"] = to_numpy(likelihood.log_density(positions))
    density = simulation.log_density_of(positions)
    if density is not None:
        values[DENSITY] = density
    return values


def _along(direction: np.ndarray, root: int, positions: np.ndarray) -> np.ndarray:
    about_root = positions - positions[:, :, root : root + 1]
    return np.einsum("nljc,ljc->n", about_root, direction)


def _height(frame: int, joint: int, positions: np.ndarray) -> np.ndarray:
    return positions[:, frame, joint, 1]


def _speed(positions: np.ndarray) -> np.ndarray:
    steps = np.diff(positions, axis=1)
    return np.sqrt((steps**2).sum(axis=-1)).mean(axis=(1, 2))

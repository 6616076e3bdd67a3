"""2D views of generated 3D motions, from random sides, to be judged beside real 2D motions."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["Angles", "film_motions", "random_azimuths"]

Angles = Literal["all", "side", "reference-code-side"]


def random_azimuths(rng: np.random.Generator, n: int, angles: Angles = "all") -> np.ndarray:
    """Return the azimuths of n cameras, radians, (n,).

    ``all`` is uniform on the circle, ``side`` uniform on (π/4, 3π/4) from the reference view,
    azimuth 0 (MAS, section 6.3); ``reference-code-side`` is π/2 for each, as what the authors'
    code calls the side.

    Raises
    ------
    ValueError
        If ``angles`` is another.
    """
    check_count("n", n)
    if angles == "all":
        return rng.uniform(0, 2 * math.pi, n)
    if angles == "side":
        return rng.uniform(math.pi / 4, 3 * math.pi / 4, n)
    if angles == "reference-code-side":
        return np.full(n, math.pi / 2)
    raise ValueError(f"angles must be one of {', '.join(get_args(Angles))}, got {angles!r}")


def film_motions(
    positions: np.ndarray,
    rng: np.random.Generator,
    *,
    elevation: float = math.pi / 16,
    distance: float = 7.0,
    angles: Angles = "all",
    root: int = 0,
) -> np.ndarray:
    """Return one perspective view of each motion: ``(N, L, J, 3) → (N, L, J, 2)``.

    The root is at the origin in every frame; views are in metres at its depth, x right, y down.

    Parameters
    ----------
    positions : ndarray, (N, L, J, 3)
        Motions, metres.
    rng : Generator
        Of one azimuth per motion.
    elevation : float
        Of all cameras, radians.
    distance : float
        From camera to root, metres.
    angles : {"all", "side", "reference-code-side"}
        Where the cameras stand; see :func:`random_azimuths`.
    root : int
        The joint that the cameras follow.

    Raises
    ------
    ValueError
        If the shape is another, a number is not finite, ``angles`` is unknown, or a joint is
        behind its camera.
    """
    check_shape("positions", positions, ("N", "L", "J", 3))
    check_finite("positions", positions)
    azimuths = random_azimuths(rng, len(positions), angles)
    centred = positions - positions[:, :, root : root + 1]
    # To go around a motion by an azimuth is to turn it by as much the other way.
    c, s = np.cos(azimuths)[:, None, None], np.sin(azimuths)[:, None, None]
    x, y, z = centred[..., 0], centred[..., 1], centred[..., 2]
    turned = np.stack([c * x - s * z, y, s * x + c * z], axis=-1)
    camera = Cameras.around(np.zeros(1), np.array([elevation]), distance=distance, perspective=True)
    return camera.project(turned)[:, 0]

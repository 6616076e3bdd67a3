"""Random 2D views of generated 3D motions, for comparison with real 2D motions."""

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

    ``all``: uniform on the circle. ``side``: uniform on (π/4, 3π/4) (MAS, section 6.3).
    ``reference-code-side``: always π/2, as in the code of the MAS authors.
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

    Views have the root at the origin in every frame, x right and y down, metres at root depth.

    Parameters
    ----------
    positions : ndarray, (N, L, J, 3)
        Motions, metres.
    rng : Generator
        Random generator of the azimuths; one azimuth is drawn per motion.
    elevation : float
        Elevation of the cameras, radians.
    distance : float
        Distance from camera to root, metres.
    angles : {"all", "side", "reference-code-side"}
        Distribution of azimuths; see :func:`random_azimuths`.
    root : int
        Index of the joint at the centre of the views.
    """
    check_shape("positions", positions, ("N", "L", "J", 3))
    check_finite("positions", positions)
    azimuths = random_azimuths(rng, len(positions), angles)
    centred = positions - positions[:, :, root : root + 1]
    # Rotate the motion instead of the camera, by the negative azimuth.
    c, s = np.cos(azimuths)[:, None, None], np.sin(azimuths)[:, None, None]
    x, y, z = centred[..., 0], centred[..., 1], centred[..., 2]
    rotated = np.stack([c * x - s * z, y, s * x + c * z], axis=-1)
    camera = Cameras.around(np.zeros(1), np.array([elevation]), distance=distance, perspective=True)
    return camera.project(rotated)[:, 0]

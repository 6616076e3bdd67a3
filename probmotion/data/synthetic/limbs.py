"""Limbs of two bones whose ends are asked to be somewhere: inverse kinematics in closed form."""

from __future__ import annotations

import numpy as np

__all__ = ["bent_limb", "rotated"]

# A limb is never quite straight (shares of its length), nor folded closer than 30 degrees.
_STRAIGHTEST = 0.99
_SOFTNESS = 0.01
_FOLD = np.cos(np.deg2rad(30.0))


def bent_limb(
    start: np.ndarray, target: np.ndarray, lengths: tuple[float, float], pole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and end of a limb that reaches from ``start`` for ``target``.

    Parameters
    ----------
    start, target : ndarray, (…, 3)
        The shoulder or hip, and where the wrist or ankle should be, metres.
    lengths : tuple of float
        Of the upper and the lower bone, metres.
    pole : ndarray, (…, 3)
        Which way the elbow or knee points; only what is square to the limb matters.

    Returns
    -------
    middle, end : ndarray, (…, 3)
        Bones have exactly their lengths. The end lies on the way to the target, at it where the
        limb can, and smoothly short of it or beyond where it is too far or too near.
    """
    upper, lower = lengths
    farthest = _STRAIGHTEST * (upper + lower)
    nearest = np.sqrt(upper**2 + lower**2 - 2 * upper * lower * _FOLD)
    way = target - start
    distance = np.linalg.norm(way, axis=-1, keepdims=True)
    along = way / np.maximum(distance, 1e-9)
    reach = farthest - _soft_positive(farthest - distance)
    reach = nearest + _soft_positive(reach - nearest)
    aside = pole - (pole * along).sum(axis=-1, keepdims=True) * along
    aside = aside / np.maximum(np.linalg.norm(aside, axis=-1, keepdims=True), 1e-9)
    cosine = (upper**2 + reach**2 - lower**2) / (2 * upper * reach)
    middle = start + upper * (cosine * along + np.sqrt(1 - cosine**2) * aside)
    return middle, start + reach * along


def rotated(frames: np.ndarray, offset: tuple[float, float, float] | np.ndarray) -> np.ndarray:
    """Return an offset in the bodies' frames as one of the world: ``(…, 3, 3), (3,) → (…, 3)``."""
    return np.asarray(frames @ np.asarray(offset))


def _soft_positive(x: np.ndarray) -> np.ndarray:
    """Return max(x, 0) with its corner rounded off."""
    return _SOFTNESS * np.logaddexp(x / _SOFTNESS, 0.0)

"""Long motions from codes of short ones: segments, and transitions whose codes are optimised.

Ponymation, appendix A: latents are drawn for consecutive segments, and transition latents are
optimised so that their first and last frames agree with the neighbours.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch

from probmotion.geometry.rotations import matrix_to_vector, vector_to_matrix
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["greatest_acceleration", "long_motion"]

_SHARED = 2
"""Frames that neighbours have in common: two say where a bone is, and how fast it turns."""
_MOST = 4
"""Codes of a transition, at most: that is as long as four segments."""
_SMOOTH = 10.0
"""Weight of squared accelerations in a transition, against squared angles that are missed."""


def long_motion(
    prior: MotionVAE,
    z: np.ndarray,
    *,
    iterations: int = 50,
    transitions: int | None = None,
    prior_weight: float = 1e-3,
) -> np.ndarray:
    """Return one long motion: the codes' segments in turn, with a transition between each two.

    A transition is one motion of the prior or several in a row. Its first two frames are the last
    two of the segment before, its last two the first two of the segment after, so that poses and
    velocities go on. Its codes minimise the squared angles between frames that are to be the same,
    plus squared accelerations and a little ‖z‖², by L-BFGS.

    What no code can meet is left as small rotations of the bones at the four frames, and is taken
    off along the cubic in time through them: exact there, and spread over the whole transition
    instead of a seam. Segments are not touched.

    Codes know no rigid pose: the body stays where the prior's path begins.

    Parameters
    ----------
    prior : MotionVAE
        Of motions of L ≥ 5 frames.
    z : ndarray, (S, Z)
        Codes of the segments, such as ``prior.initial(rng, S)``.
    iterations : int
        Of the optimiser, per transition.
    transitions : int, optional
        Codes of a transition. By default the fewest, at most four, with which no joint of it
        accelerates more than joints of the segments do; where none is enough, those with the least
        acceleration.
    prior_weight : float
        Of ‖z‖² against squared radians.

    Returns
    -------
    ndarray, (frames, J, 3)
        Metres; each transition of M codes adds M (L − 2) − 2 frames to the S L of the segments.

    Raises
    ------
    ValueError
        If the prior's motions are too short, or a shape or number is out of range.
    """
    z = np.asarray(z, dtype=np.float64)
    _check(prior, z, iterations, transitions, prior_weight)
    # One at a time, so that not even rounding depends on how many segments there are.
    segments = [torch.as_tensor(vector_to_matrix(prior.turns(code))) for code in z]
    allowed = max(greatest_acceleration(_positions(prior, part)) for part in segments)
    parts = [segments[0]]
    for neighbours, codes in zip(pairwise(segments), pairwise(z), strict=True):
        found = []
        for count in range(1, _MOST + 1) if transitions is None else [transitions]:
            between = np.linspace(*codes, count + 2)[1:-1]
            whole = _transition(prior, *neighbours, between, iterations, prior_weight)
            # A segment's own frame before and after: the seams are in it.
            around = torch.cat([neighbours[0][-3:-2], whole, neighbours[1][2:3]])
            found.append((greatest_acceleration(_positions(prior, around)), whole))
            if found[-1][0] <= allowed:
                break
        least, whole = min(found, key=lambda one: one[0])
        if least > allowed:
            warnings.warn(
                f"a joint accelerates {least / allowed:.2f} times as much at the seam after "
                f"segment {len(parts) // 2} as within any segment: no transition between these "
                "codes is smoother",
                stacklevel=2,
            )
        parts += [whole[_SHARED:-_SHARED], neighbours[1]]
    return _positions(prior, torch.cat(parts))


def _check(
    prior: MotionVAE, z: np.ndarray, iterations: int, transitions: int | None, weight: float
) -> None:
    check_shape("z", z, ("S", prior.dim))
    check_finite("z", z)
    check_count("segments", len(z))
    check_count("iterations", iterations)
    if transitions is not None:
        check_count("transitions", transitions)
    if not 0 <= weight < np.inf:
        raise ValueError(f"prior_weight must be a finite number of at least 0, got {weight}")
    if prior.frames <= 2 * _SHARED:
        raise ValueError(
            f"prior has motions of {prior.frames} frames, expected at least {2 * _SHARED + 1}: "
            f"neighbours share {_SHARED}"
        )


def greatest_acceleration(positions: np.ndarray) -> float:
    """Return the largest second difference of a joint, (L, J, 3) metres → metres per frame²."""
    check_shape("positions", positions, ("L", "J", 3))
    return float(np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1).max())


def _positions(prior: MotionVAE, rotations: torch.Tensor) -> np.ndarray:
    """Return the joints of rotations (frames, bones, 3, 3), with the rigid pose held."""
    turns = matrix_to_vector(rotations.numpy())
    rotation, translation = (
        np.repeat(part[:1], len(turns), axis=0)
        for part in (prior.rigid.rotations, prior.rigid.translations)
    )
    return prior.body.positions(turns, rotation, translation, prior.log_lengths)


def _transition(
    prior: MotionVAE,
    before: torch.Tensor,
    after: torch.Tensor,
    start: np.ndarray,
    iterations: int,
    prior_weight: float,
) -> torch.Tensor:
    """Return the rotations (frames, bones, 3, 3) of M codes' motions between two segments."""
    codes = torch.tensor(start, requires_grad=True)
    optimiser = torch.optim.LBFGS([codes], max_iter=iterations, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        whole, missed = _joined(vector_to_matrix(prior.turns(codes)), before, after)
        felt = 0.5 * (whole.diff(n=2, dim=0) ** 2).sum()
        total = missed + _SMOOTH * felt + prior_weight * (codes**2).sum()
        total.backward()
        return total

    optimiser.step(loss)
    with torch.no_grad():
        return _joined(vector_to_matrix(prior.turns(codes)), before, after)[0]


def _joined(
    motions: Sequence[torch.Tensor] | torch.Tensor, before: torch.Tensor, after: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return motions in a row (frames, bones, 3, 3), from the end of one segment to the next.

    Each begins as the last one ends. Also the squared angles, summed, by which they missed.
    """
    whole, missed = motions[0], motions[0].new_zeros(())
    for motion in motions[1:]:
        ends = torch.cat([whole[-_SHARED:], motion[-_SHARED:]])
        missed = missed + _missed(motion, ends)
        whole = torch.cat([whole, _corrected(motion, ends)[_SHARED:]])
    # Over the whole length, where it is felt least.
    ends = torch.cat([before[-_SHARED:], after[:_SHARED]])
    return _corrected(whole, ends), missed + _missed(whole, ends)


def _missed(rotations: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return half the squared difference of shared frames: squared angles, to second order."""
    return 0.5 * ((rotations[_shared_frames(len(rotations))] - ends) ** 2).sum()


def _shared_frames(frames: int) -> list[int]:
    """Return the frames that a motion shares with its neighbours."""
    return [*range(_SHARED), *range(frames - _SHARED, frames)]


def _corrected(rotations: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return rotations (L, bones, 3, 3) that are ``ends`` at the shared frames exactly."""
    times = np.arange(len(rotations), dtype=np.float64)
    known = _shared_frames(len(rotations))
    left = matrix_to_vector(rotations[known].mT @ ends)
    # The cubic through four frames: Lagrange's polynomials, (L, 4).
    cubic = np.stack(
        [
            np.prod([(times - other) / (at - other) for other in known if other != at], axis=0)
            for at in known
        ],
        axis=-1,
    )
    return rotations @ vector_to_matrix(torch.einsum("tk,kbi->tbi", torch.as_tensor(cubic), left))

"""Long motions from several latent codes, joined by optimised transitions (Ponymation, appendix A).

Each segment has a given latent code. The codes of transitions are optimised so that their first and
last frames match the neighbouring segments.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from probmotion.extras import torch
from probmotion.geometry.rotations import matrix_to_vector, vector_to_matrix
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.validation import check_count, check_finite, check_not_negative, check_shape

__all__ = ["greatest_acceleration", "long_motion"]

_OVERLAP = 2
"""Frames shared by neighbouring segments: two determine the pose and its velocity."""
_MAX_CODES = 4
"""Maximum number of codes in a transition."""
_ACCELERATION_WEIGHT = 10.0
"""Weight of squared accelerations relative to squared angle mismatches."""


def long_motion(
    prior: MotionVAE,
    z: np.ndarray,
    *,
    iterations: int = 50,
    transitions: int | None = None,
    prior_weight: float = 1e-3,
) -> np.ndarray:
    """Return one long motion: a segment per code, with a transition between neighbours.

    A transition consists of one or more motions of the prior. Its first two frames match the end
    of the previous segment, its last two frames the start of the next. L-BFGS minimises the
    squared angles between these frames, plus squared accelerations and a weak −2 log p(z). The
    remaining mismatch is removed by small bone rotations, interpolated by the cubic in time through
    the four frames. Segments are unchanged; the root pose is that of the first frame of the path.

    Parameters
    ----------
    prior : MotionVAE
        Prior of motions with L ≥ 5 frames.
    z : ndarray, (S, Z)
        Segment codes, such as ``prior.initial(rng, S)``.
    iterations : int
        L-BFGS iterations per transition.
    transitions : int, optional
        Number of codes per transition. By default the smallest, up to four, for which no joint
        accelerates more than in the segments, or else that with the smallest acceleration.
    prior_weight : float
        Weight of −2 log p(z) relative to squared radians.

    Returns
    -------
    ndarray, (frames, J, 3)
        Positions, metres: S L frames of the segments, M (L − 2) − 2 per transition of M codes.

    Raises
    ------
    ValueError
        If the prior's motions are too short, or an argument is out of range.
    """
    z = np.asarray(z, dtype=np.float64)
    _check(prior, z, iterations, transitions, prior_weight)
    # Decode one at a time, so that rounding does not depend on the number of segments.
    segments = [torch.as_tensor(vector_to_matrix(prior.turns(code))) for code in z]
    allowed = max(greatest_acceleration(_positions(prior, part)) for part in segments)
    parts = [segments[0]]
    for neighbours, codes in zip(pairwise(segments), pairwise(z), strict=True):
        candidates = []
        for count in range(1, _MAX_CODES + 1) if transitions is None else [transitions]:
            between = np.linspace(*codes, count + 2)[1:-1]
            transition = _transition(prior, *neighbours, between, iterations, prior_weight)
            # Include one frame of each segment to measure the acceleration at the seams.
            around = torch.cat([neighbours[0][-3:-2], transition, neighbours[1][2:3]])
            candidates.append((greatest_acceleration(_positions(prior, around)), transition))
            if candidates[-1][0] <= allowed:
                break
        lowest, transition = min(candidates, key=lambda candidate: candidate[0])
        if lowest > allowed:
            warnings.warn(
                f"the transition after segment {len(parts) // 2} has {lowest / allowed:.2f} times "
                "the largest acceleration of the segments; increase iterations or transitions",
                stacklevel=2,
            )
        parts += [transition[_OVERLAP:-_OVERLAP], neighbours[1]]
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
    check_not_negative("prior_weight", weight)
    if prior.frames <= 2 * _OVERLAP:
        raise ValueError(
            f"prior must have motions of at least {2 * _OVERLAP + 1} frames, got {prior.frames}"
        )


def greatest_acceleration(positions: np.ndarray) -> float:
    """Return the largest second difference of a joint, (L, J, 3) metres → metres per frame²."""
    check_shape("positions", positions, ("L", "J", 3))
    return float(np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1).max())


def _positions(prior: MotionVAE, rotations: torch.Tensor) -> np.ndarray:
    """Return joint positions of rotations (frames, bones, 3, 3) with a constant rigid pose."""
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
    """Optimise the codes between two segments; return rotations (frames, bones, 3, 3)."""
    codes = torch.tensor(start, requires_grad=True)
    optimiser = torch.optim.LBFGS([codes], max_iter=iterations, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        joined, mismatch = _joined(vector_to_matrix(prior.turns(codes)), before, after)
        acceleration = 0.5 * (joined.diff(n=2, dim=0) ** 2).sum()
        unlikely = -2 * prior.log_density(codes).sum()
        total = mismatch + _ACCELERATION_WEIGHT * acceleration + prior_weight * unlikely
        total.backward()
        return total

    optimiser.step(loss)
    with torch.no_grad():
        return _joined(vector_to_matrix(prior.turns(codes)), before, after)[0]


def _joined(
    motions: Sequence[torch.Tensor] | torch.Tensor, before: torch.Tensor, after: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Join consecutive motions between two segments, (frames, bones, 3, 3).

    Also returns the summed squared angle mismatch before correction.
    """
    joined, mismatch = motions[0], motions[0].new_zeros(())
    for motion in motions[1:]:
        ends = torch.cat([joined[-_OVERLAP:], motion[-_OVERLAP:]])
        mismatch = mismatch + _mismatch(motion, ends)
        joined = torch.cat([joined, _corrected(motion, ends)[_OVERLAP:]])
    # Spread the correction at both ends over the entire transition.
    ends = torch.cat([before[-_OVERLAP:], after[:_OVERLAP]])
    return _corrected(joined, ends), mismatch + _mismatch(joined, ends)


def _mismatch(rotations: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return half the squared difference of shared frames: squared angles to second order."""
    return 0.5 * ((rotations[_shared_frames(len(rotations))] - ends) ** 2).sum()


def _shared_frames(frames: int) -> list[int]:
    """Return the indices of the frames shared with the neighbours."""
    return [*range(_OVERLAP), *range(frames - _OVERLAP, frames)]


def _corrected(rotations: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return rotations (L, bones, 3, 3) that equal ``ends`` at the shared frames."""
    times = np.arange(len(rotations), dtype=np.float64)
    shared = _shared_frames(len(rotations))
    gaps = matrix_to_vector(rotations[shared].mT @ ends)
    # Lagrange polynomials of the cubic through four frames, (L, 4).
    cubic = np.stack(
        [
            np.prod([(times - other) / (at - other) for other in shared if other != at], axis=0)
            for at in shared
        ],
        axis=-1,
    )
    return rotations @ vector_to_matrix(torch.einsum("tk,kbi->tbi", torch.as_tensor(cubic), gaps))

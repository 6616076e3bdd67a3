"""Posterior of pose-pairs given 2D annotations (Yin et al. 2018)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.truncation import TruncatedPosterior

__all__ = ["PairSettings", "pair_posterior"]

_PRIOR = ("penetration_weight", "position_noise", "max_invalid", "bone_noise", "root_noise")
_LIKELIHOOD = (
    "n_views", "n_near", "noise", "view_bandwidth", "measure", "graph", "shortest_edge"
)  # fmt: skip


@dataclass(frozen=True)
class PairSettings:
    """Settings of the pose-pair posterior.

    Defaults are those of the paper except for ``limit``: truncated at the published 100 times the
    seed's density, the posterior is constant over most draws. The paper states no unit for
    ``noise``; ``notebooks/ablations/pose_pairs.py`` selects 0.01 m (parts noise and calibration).

    Parameters
    ----------
    penetration_weight : float
        Weight w of the squared penetration depth (eq. 2).
    position_noise : float
        Standard deviation σ_p of positions (eq. 2), metres.
    max_invalid : int
        Maximum number of joint angles beyond the limits.
    view_bandwidth : float
        Bandwidth σ_v of the view distribution (eq. 5), radians.
    shortest_edge : float
        Lower bound ε of edge lengths (eq. 8), metres.
    noise : float
        Standard deviation σ_l of eq. 9, metres (dimensionless for shape contexts).
    limit : float
        Truncation factor c of eq. 11; infinity disables truncation.
    n_views, n_near : int
        Number of views m, and number of annotations compared per view.
    measure, graph : str
        See :class:`~probmotion.interaction.annotated_pairs.AnnotatedPairs`.
    bone_noise, root_noise : float
        See :class:`~probmotion.models.pose_pairs.pose_chart.PoseChart`; not in the paper.
    """

    penetration_weight: float = 10.0
    position_noise: float = 0.05
    max_invalid: int = 8
    view_bandwidth: float = 0.5
    shortest_edge: float = 0.05
    noise: float = 0.01
    limit: float = math.inf
    n_views: int = 32
    n_near: int = 32
    measure: str = "interaction"
    graph: str = "delaunay"
    bone_noise: float = 0.05
    root_noise: float = 1.0

    @classmethod
    def paper(cls) -> PairSettings:
        """Return the settings of the paper."""
        return cls(limit=100.0)


def pair_posterior(
    seed: np.ndarray,
    annotations: Annotations | None,
    settings: PairSettings | None = None,
    *,
    skeleton: Skeleton | None = None,
    fps: float = 30.0,
    limits: JointLimits | None = None,
    view_seed: int = 0,
) -> TruncatedPosterior:
    """Return the posterior of pose-pairs around a seed (Yin et al. 2018, eqs. 1-11).

    Parameters
    ----------
    seed : ndarray, (J, 3) or (S, J, 3)
        One or several 3D pose-pairs, metres. The first has θ = 0; truncation is relative to it.
    annotations : Annotations or None
        Annotated pairs; unknown views are estimated from the seed. ``None``: prior alone.
    settings : PairSettings, optional
        Settings of the prior and the likelihood.
    skeleton : Skeleton, optional
        Skeleton of the seed; ``pair17`` by default.
    fps : float
        Frames per second; the annotations' frame rate replaces it if there are annotations.
    limits : JointLimits, optional
        Joint limits; the shipped ones by default.
    view_seed : int
        Random seed of the views, which stay fixed.

    Raises
    ------
    ValueError
        If a seed is outside the support of the prior or of the truncated posterior.
    """
    settings = PairSettings() if settings is None else settings
    prior = PosePairPrior(
        seed,
        Skeleton.preset("pair17") if skeleton is None else skeleton,
        fps=fps if annotations is None else annotations.fps,
        limits=limits,
        **{name: getattr(settings, name) for name in _PRIOR},
    )
    likelihood = None
    if annotations is not None:
        options = {name: getattr(settings, name) for name in _LIKELIHOOD} | {"seed": view_seed}
        if annotations.views is None:
            likelihood = AnnotatedPairs.estimated(annotations, prior.seed[0], **options)
        else:
            likelihood = AnnotatedPairs(annotations, **options)
    posterior = TruncatedPosterior(prior, likelihood, limit=settings.limit)
    log_density = posterior.log_density(prior.seed_coordinates())
    if not np.isfinite(log_density).all():
        worst = int(log_density.argmin())
        raise ValueError(
            f"seed {worst} must have at least 1/{settings.limit:g} of the first seed's density, "
            "got less; increase limit or choose another seed"
        )
    return posterior

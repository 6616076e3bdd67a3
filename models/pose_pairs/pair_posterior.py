"""Pose-pairs after annotations: prior, likelihood and truncation under one set of names."""

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


@dataclass(frozen=True)
class PairSettings:
    """Every number of the posterior over pose-pairs.

    The published ones, but for ``limit``: a density that is cut at 100 times the seed's is flat
    where most draws are. ``noise``, of which the paper does not say the unit, does in metres: draws
    cover better than the seed alone up to .01 and worse from .02 on, and below .01 real pairs are
    far less likely than draws (``notebooks/ablations/pose_pairs.py``, parts noise and calibration).

    Parameters
    ----------
    penetration_weight : float
        w of eq. 2.
    position_noise : float
        σ_p of eq. 2, metres.
    max_invalid : int
        Most joint angles beyond the limits.
    view_bandwidth : float
        σ_v of eq. 5, radians.
    shortest_edge : float
        ε of eq. 8, metres.
    noise : float
        σ_l of eq. 9, in the unit of the measure: metres, but for shape contexts, which have none.
    limit : float
        c of eq. 11; infinity does not truncate.
    n_views, n_near : int
        Views m, and annotations that each is compared with.
    measure, graph : str
        What projections are compared in; see
        :class:`~probmotion.interaction.annotated_pairs.AnnotatedPairs`.
    bone_noise, root_noise : float
        How far bones' log lengths and the people's places are free, which the paper leaves open.
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
        """Return the published numbers."""
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
    """Return the posterior over pose-pairs around a seed (Yin et al. 2018, eqs. 1-11).

    Parameters
    ----------
    seed : ndarray, (J, 3) or (S, J, 3)
        One 3D pose-pair, metres, or several; the first is θ = 0 and the reference of truncation.
    annotations : Annotations or None
        The annotated pairs; their views are estimated from the seed where they are not known.
        ``None`` leaves the prior alone.
    settings : PairSettings, optional
        The numbers.
    skeleton : Skeleton, optional
        Of the seed; ``pair17`` by default.
    fps : float
        Frames per second of the motion; the annotations', where there are any.
    limits : JointLimits, optional
        What joints can do; the table that is shipped by default.
    view_seed : int
        Seed of the fixed views.

    Raises
    ------
    ValueError
        If the seed is outside the prior's support or has density 0.
    """
    settings = PairSettings() if settings is None else settings
    prior = PosePairPrior(
        seed,
        Skeleton.preset("pair17") if skeleton is None else skeleton,
        fps=fps if annotations is None else annotations.fps,
        limits=limits,
        penetration_weight=settings.penetration_weight,
        position_noise=settings.position_noise,
        max_invalid=settings.max_invalid,
        bone_noise=settings.bone_noise,
        root_noise=settings.root_noise,
    )
    likelihood = None
    if annotations is not None:
        numbers = {
            "n_views": settings.n_views,
            "n_near": settings.n_near,
            "noise": settings.noise,
            "view_bandwidth": settings.view_bandwidth,
            "measure": settings.measure,
            "graph": settings.graph,
            "shortest_edge": settings.shortest_edge,
            "seed": view_seed,
        }
        if annotations.views is None:
            likelihood = AnnotatedPairs.estimated(annotations, prior.seed[0], **numbers)
        else:
            likelihood = AnnotatedPairs(annotations, **numbers)  # type: ignore[arg-type]
    posterior = TruncatedPosterior(prior, likelihood, limit=settings.limit)
    log_density = posterior.log_density(prior.seed_coordinates())
    if not np.isfinite(log_density).all():
        worst = int(log_density.argmin())
        raise ValueError(
            f"seed {worst} is below 1/{settings.limit:g} of the first seed's density, where "
            "truncation leaves nothing: expected seeds of like density, or a greater limit"
        )
    return posterior

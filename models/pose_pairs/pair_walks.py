"""Metropolis walks over pose pairs and views, for tempering samplers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from probmotion.arrays import logsumexp
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.local_frames import chest_joints, joint_roots
from probmotion.interaction.annotations.views import view_vectors
from probmotion.models.pose_pairs.pair_densities import (
    Physics,
    ViewAnnotations,
    log_prior,
    log_prior_terms,
    log_view,
    log_views,
    workspace,
)
from probmotion.models.pose_pairs.pair_moves import Body, moves_of
from probmotion.models.pose_pairs.pair_walk_kernels import walk
from probmotion.models.pose_pairs.pose_chart import PoseChart

__all__ = ["PairWalks", "body_of"]


def body_of(chart: PoseChart) -> Body:
    """Return the skeleton and the seed of a chart for compiled code."""
    skeleton = chart.skeleton
    below = np.eye(skeleton.n_joints, dtype=bool)
    for joint in range(skeleton.n_joints):
        below[list(skeleton.ancestors(joint)), joint] = True
    roots, chests = np.array(skeleton.roots), np.array(chest_joints(skeleton))
    return Body(
        parents=np.array(skeleton.parents, dtype=np.int64),
        below=below,
        roots=roots,
        chests=chests,
        framing=np.asarray(below[:, chests].any(axis=1)),
        person=np.searchsorted(roots, joint_roots(skeleton)),
        seed=chart.seed,
        bone_noise=chart.bone_noise,
        root_noise=chart.root_noise,
    )


@dataclass(frozen=True, eq=False)
class PairWalks:
    """Compiled walks of :mod:`.pair_walk_kernels`; see the protocol ``Walks``."""

    body: Body
    physics: Physics
    views: ViewAnnotations

    @classmethod
    def of(cls, body: Body, physics: Physics, likelihood: AnnotatedPairs) -> PairWalks:
        """Return the walks of a prior with this body and physics, and a likelihood."""
        vectors, prepared = view_vectors(likelihood.views), likelihood.comparer.prepared
        views = ViewAnnotations(vectors, likelihood.near, prepared, likelihood.noise)
        return cls(body, physics, views)

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.views.vectors)

    @cached_property
    def moves(self) -> np.ndarray:
        """Kinds and joints of the moves, (n_moves, 3)."""
        return moves_of(self.body)

    def terms(self, pose: np.ndarray) -> np.ndarray:
        """Return the terms of the log prior of a pose (J, 3), which :meth:`walk` updates."""
        parts = np.empty(2 + 2 * len(self.body.roots))
        work = workspace(self.body, self.physics, 0)
        log_prior_terms(pose, self.body, self.physics, parts, work)
        return parts

    def log_view(self, pose: np.ndarray, view: int) -> float:
        """Return the log likelihood of one view."""
        return float(log_view(pose, view, self.body, self.views, -np.inf))

    def log_density(self, pose: np.ndarray, terms: np.ndarray) -> float:
        """Return the log posterior density relative to the base measure, up to a constant."""
        logs = log_views(pose, self.body, self.views)
        log_f = log_prior(terms, self.physics) - terms[0]
        return float(log_f + logsumexp(logs) - math.log(len(logs)))

    def walk(
        self,
        pose: np.ndarray,
        terms: np.ndarray,
        view: int,
        power: float,
        steps: int,
        sizes: np.ndarray,
        tried: np.ndarray,
        taken: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple[int, float]:
        """Take Metropolis steps; return the view and its log likelihood. Arrays are updated."""
        return walk(
            pose, terms, view, power, steps, self.moves, sizes, tried, taken, self.body,
            self.physics, self.views, rng,
        )  # fmt: skip

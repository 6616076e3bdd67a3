"""Physical prior of poses of closely interacting people (Yin et al. 2018, eq. 2)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from probmotion.arrays import Array, to_numpy
from probmotion.data.pair_sets import check_close_people
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.pair_densities import Physics
from probmotion.models.pose_pairs.pair_moves import Body
from probmotion.models.pose_pairs.pair_walks import PairWalks, body_of
from probmotion.models.pose_pairs.penetration import capsules_of, penetration_depth
from probmotion.models.pose_pairs.pose_chart import PoseChart
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Likelihood
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["PosePairPrior"]

# Standard deviation of initial points around a seed, so that ensemble walkers are distinct.
_JITTER = 1e-3


@dataclass(frozen=True, eq=False)
class PosePairPrior:
    """Prior f(Θ) = exp(−E(X(Θ))/2σ_p²), 0 for more than ``max_invalid`` invalid joint angles.

    The energy is ``E = ‖X − X̂‖² + w ρ²`` (eq. 2), with the pose X, the pose X̂ closest to it within
    the joint limits and the total penetration depth ρ, metres. The unnormalised density is relative
    to the measure :meth:`PoseChart.log_measure`: eq. 2 is improper in position and bone lengths.

    Parameters
    ----------
    seed : ndarray, (J, 3) or (S, J, 3)
        Initial poses of chains, metres; the first has θ = 0. People must be close and poses
        within the support.
    skeleton : Skeleton
        Skeleton of the J joints, K trees, with bone radii.
    fps : float
        Frames per second of the motion.
    limits : JointLimits, optional
        Joint limits; the shipped ones by default.
    penetration_weight : float
        Weight w of the squared penetration depth (eq. 2).
    position_noise : float
        Standard deviation σ_p of positions (eq. 2), metres.
    max_invalid : int
        Maximum number of joint angles beyond the limits.
    bone_noise, root_noise : float
        See :class:`~probmotion.models.pose_pairs.pose_chart.PoseChart`.
    """

    seed: np.ndarray
    skeleton: Skeleton
    fps: float = 30.0
    limits: JointLimits | None = None
    penetration_weight: float = 10.0
    position_noise: float = 0.05
    max_invalid: int = 8
    bone_noise: float = 0.05
    root_noise: float = 1.0
    chart: PoseChart = field(init=False, repr=False)
    joint_limits: JointLimits = field(init=False, repr=False)

    frames = 1
    differentiable = False

    def __post_init__(self) -> None:
        check_positive("fps", self.fps)
        check_positive("penetration_weight", self.penetration_weight)
        check_positive("position_noise", self.position_noise)
        check_count("max_invalid", self.max_invalid, least=0)
        poses = np.asarray(self.seed, dtype=np.float64)
        poses = poses[None] if poses.ndim == 2 else poses
        check_shape("seed", poses, ("S", self.skeleton.n_joints, 3))
        if len(poses) == 0:
            raise ValueError("seed must contain at least one pose, got none")
        if self.skeleton.radii is None:
            raise ValueError("skeleton must have bone radii, one per joint, got none")
        for number, pose in enumerate(poses):
            check_close_people(f"seed {number}", pose, self.skeleton)
        chart = PoseChart(poses[0], self.skeleton, self.bone_noise, self.root_noise)
        limits = JointLimits.shipped() if self.limits is None else self.limits
        object.__setattr__(self, "joint_limits", limits.on(self.skeleton))
        object.__setattr__(self, "chart", chart)
        object.__setattr__(self, "seed", poses)
        for number, pose in enumerate(poses):
            invalid = self.invalid_joints(pose)
            if len(invalid) > self.max_invalid:
                raise ValueError(
                    f"seed {number} must have at most {self.max_invalid} joint angles beyond the "
                    f"limits (max_invalid), got {len(invalid)}: {', '.join(invalid)}"
                )

    @property
    def dim(self) -> int:
        """Number of coordinates, 6 K + 3 (J − K): 108 for ``pair17``."""
        return self.chart.dim

    def motion(self, theta: Array) -> Array:
        """Return the pose at θ as a one-frame motion: ``(…, dim) → (…, 1, J, 3)``, metres."""
        return self.chart.positions(theta)[..., None, :, :]

    def coordinates(self, poses: np.ndarray) -> np.ndarray:
        """Return θ of each pose, e.g. for ``initial=`` of a sampler: ``(…, J, 3) → (…, dim)``."""
        return self.chart.coordinates(poses)

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n initial points, (n, dim): the seeds, repeated cyclically, plus small noise."""
        chosen = self.seed_coordinates()[np.arange(n) % len(self.seed)]
        return chosen + _JITTER * rng.standard_normal((n, self.dim))

    def seed_coordinates(self) -> np.ndarray:
        """Return θ of the seeds, (S, dim)."""
        return self.chart.coordinates(self.seed)

    def log_density(self, theta: Array) -> np.ndarray:
        """Return log f(Θ) plus the log base measure, up to a constant: ``(…, dim) → (…)``."""
        return self.density_and_motion(theta)[0]

    def density_and_motion(self, theta: Array) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`log_density` and :meth:`motion`, ``(…, dim) → (…), (…, 1, J, 3)``."""
        theta = to_numpy(theta)
        log_measure = self.log_measure(theta)
        flat = theta.reshape(-1, self.dim)
        # Exponentials of log bone lengths can overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            positions = self.motion(flat)
        inside = np.isfinite(log_measure.reshape(-1)) & np.isfinite(positions).all(axis=(1, 2, 3))
        log_f = np.full(len(flat), -np.inf)
        log_f[inside] = self.log_plausibility(positions[inside])
        shaped = log_f.reshape(log_measure.shape)
        log_density = np.where(shaped > -np.inf, log_measure, 0.0) + shaped
        return log_density, positions.reshape(*theta.shape[:-1], *positions.shape[1:])

    def log_measure(self, theta: Array) -> np.ndarray:
        """Return the log base measure: ``(…, dim) → (…)``."""
        return self.chart.log_measure(theta)

    def log_plausibility(self, positions: Array) -> np.ndarray:
        """Return log f of poses (eq. 2), at most 0: ``(…, 1, J, 3) → (…)``."""
        positions = to_numpy(positions)
        check_shape("positions", positions, ("…", 1, self.skeleton.n_joints, 3))
        poses = np.ascontiguousarray(positions.reshape(-1, self.skeleton.n_joints, 3))
        valid, nearest = self.joint_limits.project(poses)
        squared = ((poses - nearest) ** 2).sum(axis=(-2, -1))
        energy = squared + self.penetration_weight * penetration_depth(poses, self.skeleton) ** 2
        allowed = (~valid).sum(axis=-1) <= self.max_invalid
        log_f = np.where(allowed, -0.5 * energy / self.position_noise**2, -np.inf)
        return log_f.reshape(positions.shape[:-3])

    def coordinate_speeds(self, joint_speeds: np.ndarray) -> np.ndarray:
        """Return the mean squared step of each coordinate: ``(…, J, 2) → (…, dim)``.

        ``joint_speeds`` contains each joint's mean squared turn, radians², and stretch, metres².
        """
        return self.chart.speeds(joint_speeds[..., 0], joint_speeds[..., 1])

    def walks(self, likelihood: Likelihood | None) -> PairWalks | None:
        """Return walks over poses and views, or None unless annotations show all joints."""
        if type(likelihood) is not AnnotatedPairs or not likelihood.annotations.visible.all():
            return None
        return PairWalks.of(self.body, self.physics, likelihood)

    @cached_property
    def body(self) -> Body:
        """Skeleton and seed for compiled code."""
        return body_of(self.chart)

    @cached_property
    def physics(self) -> Physics:
        """Joint limits and penetration for compiled code."""
        return Physics(
            self.joint_limits.trees,
            self.joint_limits.arrays,
            *capsules_of(self.skeleton),
            self.penetration_weight,
            self.position_noise,
            self.max_invalid,
        )

    def invalid_joints(self, pose: np.ndarray) -> list[str]:
        """Return the names of the joints of a pose (J, 3) beyond the limits."""
        valid = self.joint_limits.is_valid(pose)
        names = [self.skeleton.joint_names[joint] for joint, _ in self.skeleton.bones]
        return [name for name, is_valid in zip(names, valid, strict=True) if not is_valid]

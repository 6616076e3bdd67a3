"""Accuracy of priors of pose pairs that are learnt from annotations.

For ``accuracy.py exact-priors``: coverages are mean distances from held-out pose pairs to the
nearest lifted annotation in interaction coordinates, metres
(:func:`probmotion.metrics.coverage.coverage`); ``salsa_lift_mm`` is the rms error of lifted joints
after rigid alignment; ``completion_m`` is the mean error of hidden joints in the image. Annotations
of the training clips are in random views that are unknown to the methods; three of ten salsa clips,
and two of eight synthetic dances, are held out. The defaults of the initial spread (EM), the ridge
and the noise of the completions were chosen after looks at the held-out salsa clips;
``--held-out`` names other clips, on which none was.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from arviz_stats.base import array_stats

from probmotion import seeds
from probmotion.data.downloads import salsa_pairs
from probmotion.data.pair_sets import (
    SALSA_HELD_OUT,
    choose_seed,
    dance_frames,
    ground_truth,
    hold_out,
)
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import (
    DrawnAnnotations,
    draw_annotations,
    world_axes,
)
from probmotion.interaction.completion import (
    nearest_annotation_completion,
    occluded_joint_error,
)
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.regression import ridge_completion
from probmotion.metrics.coverage import coverage
from probmotion.models.pose_pairs import PosePairPrior, penetration_depth
from probmotion.models.pose_pairs.pair_posterior import pair_posterior
from probmotion.models.unseen_depth import AnnotationLifts, AnnotationPrior, physical_lifts
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.problems.references.making import agreement

COMPLETIONS = 60  # held-out annotations whose joints are completed
FOCAL = 1000.0  # pixels, of the perspective cameras
DISTANCES = (2.5, 5.0)  # of the perspective cameras, metres

Figures = Iterator[tuple[str, float]]


class Pairs:
    """Pose pairs of training and held-out clips, and annotations of the former."""

    def __init__(self, motions: list[Motion], held_out: tuple[str, ...], n_held_out: int) -> None:
        self.training, self.test = hold_out(motions, held_out)
        self.covered = ground_truth(self.test, n_held_out)[0]
        poses = ground_truth(self.training)[0]
        self.start = poses[choose_seed(poses)]

    def annotated(self, n: int, seed: int = 0, **settings: object) -> DrawnAnnotations:
        """Return n annotations of the training clips."""
        frames = [dance_frames(motion) for motion in self.training]
        return draw_annotations(self.training, n, seed, frames=frames, **settings)  # type: ignore[arg-type]

    def asked(self, n: int, seed: int = 0, **settings: object) -> DrawnAnnotations:
        """Return n annotations of the held-out clips."""
        frames = [dance_frames(motion) for motion in self.test]
        return draw_annotations(self.test, n, seed, frames=frames, **settings)  # type: ignore[arg-type]

    def fitted(self, drawn: DrawnAnnotations) -> tuple[AnnotationPrior, AnnotationLifts]:
        """Return the prior learnt from annotations, and the annotations lifted by it."""
        prior = AnnotationPrior.fit(drawn.annotations, self.start)
        return prior, prior.lift(drawn.annotations)

    def coverage(self, poses: np.ndarray) -> float:
        """Return the coverage of the held-out pairs in interaction coordinates."""
        return float(coverage(self.covered, poses, "interaction"))

    @cached_property
    def all(self) -> DrawnAnnotations:
        """All annotations, up to 6000."""
        total = sum(int(dance_frames(motion).sum()) for motion in self.training)
        return self.annotated(min(total, 6000))


def salsa(folder: str | Path, held_out: tuple[str, ...] = SALSA_HELD_OUT) -> Pairs:
    """Return the pairs of CMU's salsa clips."""
    return Pairs(salsa_pairs(folder), held_out, 300)


def dances() -> Pairs:
    """Return the pairs of the synthetic dances of the problem ``dance-pairs``."""
    return Pairs(synthetic_dances(8, seed=0), ("dance-6", "dance-7"), 60)


def in_camera(drawn: DrawnAnnotations) -> np.ndarray:
    """Return the true poses in camera axes, with depths relative to their mean."""
    poses = np.einsum("nai,nji->nja", world_axes(drawn.world_views), drawn.positions)
    poses[..., 2] -= poses[..., 2].mean(axis=1, keepdims=True)
    return poses


def lift_error(lifts: AnnotationLifts, drawn: DrawnAnnotations) -> float:
    """Return the rms error of lifted joints after rigid alignment, metres."""
    aligned = np.asarray(align_rigidly(lifts.positions, drawn.positions))
    return float(np.sqrt(((aligned - drawn.positions) ** 2).sum(axis=-1).mean()))


def intervals(lifts: AnnotationLifts, drawn: DrawnAnnotations) -> np.ndarray:
    """Return whether each true coordinate is in its 90 % interval, (n, J, 3)."""
    return np.abs(in_camera(drawn) - lifts.positions) < 1.645 * lifts.sd


def lifting_figures(pairs: Pairs) -> Figures:
    """Yield coverage, error and calibration of annotations lifted by the annotation prior."""
    prior, lifts = pairs.fitted(pairs.all)
    yield "salsa_coverage_ic_5600", pairs.coverage(lifts.positions)
    yield "salsa_lift_mm", 1000 * lift_error(lifts, pairs.all)
    asked = pairs.asked(600, seed=5)
    of_asked = prior.lift(asked.annotations)
    within = intervals(of_asked, asked)
    yield "salsa_held_out_lift_mm", 1000 * lift_error(of_asked, asked)
    yield "salsa_lift_interval_90", within.mean()
    yield "salsa_lift_interval_90_depth", within[..., 2].mean()
    few = pairs.annotated(300, seed=1)
    yield "salsa_coverage_ic_300", pairs.coverage(pairs.fitted(few)[1].positions)
    synthetic = dances()
    drawn = synthetic.annotated(300)
    yield "dance_coverage_ic", synthetic.coverage(synthetic.fitted(drawn)[1].positions)


def physical_figures(pairs: Pairs) -> Figures:
    """Yield figures of 2000 draws, one of each annotation, with and without the physical prior.

    Lengths of bones are relative to those of the people. ``log_likelihood`` (eq. 9 of Yin et al.
    2018, mean over views, of 300 draws) and ``root_distance`` are medians, also of the held-out
    pairs. ``rhat`` is the median, over 20 annotations, of the largest R-hat of a coordinate, with
    four chains of 40 draws, and ``largest_rhat`` the largest. ``agreement`` is the share of these
    annotations on which two such runs agree within the limits for references.
    """
    prior, drawn = pairs.fitted(pairs.all)[0], pairs.annotated(2000, seed=1)
    physics = PosePairPrior(pairs.start, Skeleton.preset("pair17"))
    keypoints, truth = drawn.annotations.keypoints, in_camera(drawn)
    physical_lifts(prior, keypoints[:1], physics)  # Compile.
    start = time.perf_counter()
    informed = physical_lifts(prior, keypoints, physics)[0]
    yield "informed_pairs_seconds", time.perf_counter() - start
    gaussian = prior.sample_lifts(keypoints, np.random.default_rng(0), 1)[0]
    joints, parents = np.array(physics.skeleton.bones).T
    lengths = [
        np.linalg.norm(poses[:, joints] - poses[:, parents], axis=-1)
        for poses in (informed, gaussian, truth)
    ]
    for number, (name, poses) in enumerate((("informed", informed), ("gaussian", gaussian))):
        yield f"{name}_pairs_coverage_ic", pairs.coverage(poses)
        yield f"{name}_pairs_bone_sd", float(np.log(lengths[number] / lengths[2]).std())
        depths = penetration_depth(poses, physics.skeleton)
        yield f"{name}_pairs_penetration_cm", 100 * float(depths.mean())
        invalid = ~physics.joint_limits.is_valid(poses)
        yield f"{name}_pairs_invalid_angles", float(invalid.sum(axis=-1).mean())
        centred = poses - poses.mean(axis=1, keepdims=True)
        error = np.linalg.norm(centred - truth + truth.mean(axis=1, keepdims=True), axis=-1)
        yield f"{name}_pairs_error_mm", 1000 * float(error.mean())
    likelihood = pair_posterior(pairs.start, pairs.all.annotations).likelihood
    assert likelihood is not None
    roots = list(physics.skeleton.roots)
    for name, poses in (
        ("informed", informed),
        ("gaussian", gaussian),
        ("held_out", pairs.covered),
    ):
        logs = likelihood.log_density(poses[:300, None])
        yield f"{name}_pairs_log_likelihood", float(np.median(logs))
        apart = np.linalg.norm(poses[:, roots[0]] - poses[:, roots[1]], axis=-1)
        yield f"{name}_pairs_root_distance_m", float(np.median(apart))
    chains = np.stack(
        [physical_lifts(prior, keypoints[:20], physics, draws=40, seed=chain) for chain in range(8)]
    )
    rhat = array_stats.rhat(chains[:4].reshape(4, 40, -1), chain_axis=0, draw_axis=1)
    largest = rhat.reshape(20, -1).max(axis=1)
    yield "informed_pairs_rhat", float(np.median(largest))
    yield "informed_pairs_largest_rhat", float(largest.max())
    runs = (agreement(*np.split(chains[:, :, k, None], 2), seed=0) for k in range(20))
    yield "informed_pairs_agreement", float(np.mean([agreed(run) for run in runs]))


def agreed(run: Mapping[str, float]) -> bool:
    """Return whether discrepancies are within the limits of references."""
    return all(run[name] <= run[f"{name}_at_most"] for name in ("swd_ratio", "mean_z"))


def robustness_figures(pairs: Pairs) -> Figures:
    """Yield coverages with other cameras, noise, body proportions and numbers of components."""
    drawn = pairs.all
    n = len(drawn.positions)
    yield "salsa_coverage_ic_true_pairs", pairs.coverage(drawn.positions)
    first = {clip: drawn.world_views[drawn.clips == clip][0] for clip in np.unique(drawn.clips)}
    fixed = pairs.annotated(n, world_views=np.stack([first[clip] for clip in drawn.clips]))
    noisy = pairs.annotated(n, noise=0.01)
    for name, annotated in (("one_camera_per_clip", fixed), ("noise_1cm", noisy)):
        yield f"salsa_coverage_ic_{name}", pairs.coverage(pairs.fitted(annotated)[1].positions)
    three = AnnotationPrior.fit(drawn.annotations, pairs.start, components=3)
    lifts = three.lift(drawn.annotations)
    yield "salsa_coverage_ic_3_components", pairs.coverage(lifts.positions)
    yield "salsa_lift_mm_3_components", 1000 * lift_error(lifts, drawn)
    other = _other_bodies(pairs)
    bodies = other.all
    lifts = other.fitted(bodies)[1]
    yield "salsa_coverage_ic_other_bodies", pairs.coverage(lifts.positions)
    yield "salsa_lift_mm_other_bodies", 1000 * lift_error(lifts, bodies)
    prior = pairs.fitted(drawn)[0]
    keypoints, metres = _perspective(drawn)
    for name, lifts in (
        ("orthographic", pairs.fitted(replace_keypoints(drawn, keypoints * metres))[1]),
        ("weak", _fit_and_lift(keypoints, pairs.start, unknown_scale=True)),
        ("known_focal", _fit_and_lift(keypoints, pairs.start, focal=FOCAL)),
        ("weak_known_prior", prior.lift(keypoints, unknown_scale=True)),
        ("known_focal_known_prior", prior.lift(keypoints, focal=FOCAL)),
    ):
        yield f"salsa_coverage_ic_perspective_{name}", pairs.coverage(lifts.positions)
        yield f"salsa_lift_mm_perspective_{name}", 1000 * lift_error(lifts, drawn)


def completion_figures(pairs: Pairs) -> Figures:
    """Yield mean errors of hidden joints, in the image and in 3D, and calibration, by hiding."""
    bank = pairs.all.annotations
    whole = pairs.asked(COMPLETIONS)
    keypoints, truth = whole.annotations.keypoints, in_camera(whole)
    prior = AnnotationPrior.fit(bank, pairs.start, noise=0.01)
    names = np.array(bank.skeleton.joint_names)
    arms = np.array([name.endswith(("elbow", "wrist")) for name in names])
    first = np.arange(len(names)) < bank.skeleton.roots[1]
    random = pairs.asked(COMPLETIONS, hidden=0.3).annotations.visible
    left = np.array(["left" in name for name in names])
    for label, visible in (
        ("", random),
        ("_one_arm", np.broadcast_to(~(arms & first & left), random.shape)),
        ("_all_arms", np.broadcast_to(~arms, random.shape)),
        ("_second_person", np.broadcast_to(first, random.shape)),
    ):
        lifts = prior.lift(np.where(visible[..., None], keypoints, np.nan))
        ridge = [
            ridge_completion(points, seen, bank.keypoints)
            for points, seen in zip(keypoints, visible, strict=True)
        ]
        nearest = [
            nearest_annotation_completion(points, seen, bank.keypoints, bank.skeleton).positions
            for points, seen in zip(keypoints, visible, strict=True)
        ]
        completed = np.stack([result.positions for result in ridge])
        sd = np.stack([result.sd for result in ridge])
        within = {
            "ridge": (np.abs(completed - keypoints) < 1.645 * sd)[~visible],
            "prior": intervals(lifts, whole)[~visible],
        }
        yield f"completion{label}_m", _hidden_error(keypoints, completed, visible)
        yield (
            f"completion{label}_prior_m",
            _hidden_error(keypoints, lifts.positions[..., :2], visible),
        )
        yield f"completion{label}_prior_3d_m", _hidden_error(truth, lifts.positions, visible)
        yield f"completion{label}_nearest_m", _hidden_error(keypoints, np.stack(nearest), visible)
        for method, inside in within.items():
            yield f"completion{label}_{method}_interval_90", inside.mean()


def replace_keypoints(drawn: DrawnAnnotations, keypoints: np.ndarray) -> DrawnAnnotations:
    """Return the drawn annotations with other keypoints."""
    return replace(drawn, annotations=replace(drawn.annotations, keypoints=keypoints))


def _hidden_error(truth: np.ndarray, estimate: np.ndarray, visible: np.ndarray) -> float:
    """Return the mean over annotations of the error of the hidden joints."""
    rows = zip(truth, estimate, ~visible, strict=True)
    return float(np.mean([occluded_joint_error(*row) for row in rows]))


def _fit_and_lift(
    keypoints: np.ndarray,
    start: np.ndarray,
    unknown_scale: bool = False,
    focal: float | None = None,
) -> AnnotationLifts:
    prior = AnnotationPrior.fit(keypoints, start, unknown_scale=unknown_scale, focal=focal)
    return prior.lift(keypoints, unknown_scale=unknown_scale, focal=focal)


def _other_bodies(pairs: Pairs) -> Pairs:
    """Return pairs whose people have, in each clip, other limb lengths and other heights."""
    rng = seeds.generator(0, "bodies")
    skeleton = pairs.training[0].skeleton
    motions = []
    for motion in pairs.training:
        positions = motion.positions.copy()
        factors = rng.uniform(0.85, 1.15, skeleton.n_joints)
        for joint, parent in enumerate(skeleton.parents):  # parents come before their children
            if parent >= 0:
                bone = motion.positions[:, joint] - motion.positions[:, parent]
                positions[:, joint] = positions[:, parent] + factors[joint] * bone
        motions.append(replace(motion, positions=positions, rest_offsets=None))
    held_out = tuple(motion.name for motion in pairs.test)
    other = Pairs([*motions, *pairs.test], held_out, len(pairs.covered))
    other.start = pairs.start
    return other


def _perspective(drawn: DrawnAnnotations) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints (n, J, 2) of pinhole cameras, pixels, and metres per pixel (n, 1, 1)."""
    rng = seeds.generator(0, "perspective")
    seen = in_camera(drawn)
    seen[..., :2] -= seen[..., :2].mean(axis=1, keepdims=True)
    n = len(seen)
    distance = rng.uniform(*DISTANCES, (n, 1, 1))
    offset = rng.uniform(-0.5, 0.5, (n, 1, 2))
    return FOCAL * (seen[..., :2] + offset) / (distance - seen[..., 2:]), distance / FOCAL


PARTS = {
    "lifting": lifting_figures,
    "physical": physical_figures,
    "robustness": robustness_figures,
    "completion": completion_figures,
}

"""Pose-pair densities compared by chains that have mixed: Yin et al. (2018), figures 5, 8, 10 to 12.

    python notebooks/ablations/mixed_pairs.py --out mixed-pairs
    python notebooks/ablations/mixed_pairs.py --quick --out quick     (synthetic dances, minutes)

``--parts`` selects annotations, converged, retrieval and completion; each writes a CSV file and
figures to ``--out``. Draws are of ``tempered-pairs``, stored in ``--out/comparisons``: run the same
command again to resume an interrupted study. Options and data are those of ``pose_pairs.py``, but
all densities have 400 draws, and ``--repeats`` is of the part converged alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from pose_pairs import SEED, Runs, Study, embed, evenly, main, step_by_step

from probmotion import seeds
from probmotion.data.pair_sets import dance_frames
from probmotion.interaction.annotations.backbones import annotation_views
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.completion import (
    complete_keypoints,
    nearest_annotation_completion,
    occluded_joint_error,
)
from probmotion.interaction.geometry.coordinates import align_rigidly, interaction_distance
from probmotion.interaction.geometry.pose_distances import MEASURES
from probmotion.interaction.retrieval import retrieve, views_around
from probmotion.metrics.coverage import coverage
from probmotion.models.pose_pairs import PosePairPrior
from probmotion.models.pose_pairs.single_pose_lifting import lift_people
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.coverage import classical_scaling
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.style import GREY, LEFT, PAGE, RIGHT, finish_figure
from probmotion.samplers import TemperedPairs


class MixedStudy(Study):
    """Study whose chains mix."""

    def mixed(self, variants: Mapping[str, Mapping[str, Any]], repeats: int) -> Runs:
        """Return draws of parallel tempering from densities without truncation."""
        problems = {
            f"{name}, repeat {repeat}": {**settings, "repeat": repeat, "limit": np.inf}
            for repeat in range(repeats)
            for name, settings in variants.items()
        }
        effort = {"warmup": 30, "thin": 2} if self.quick else {"warmup": 600, "thin": 10}
        samplers = {"tempered-pairs": TemperedPairs(levels=24, steps=120, **effort)}
        return self.compared("mixed", problems, samplers, 400)

    @cached_property
    def by_tempering(self) -> Runs:
        """Draws from the densities that are compared.

        All distances have the same annotations and views. Of 5599 annotations, 855 are among the
        nearest ones of 32 views, and 5596 among those of 2048.
        """
        variants: dict[str, dict[str, Any]] = {
            f"{density} {size}": {"density": density, "noise": size}
            for size in (0.005, 0.01)
            for density in ("interaction", "cartesian", "shape-context")
        }
        variants["2048 views"] = {"density": "interaction", "noise": 0.01, "n_views": 2048}
        return self.mixed(variants, self.repeats)

    @cached_property
    def states(self) -> np.ndarray:
        """Draws in interaction coordinates at the published σ_l, (400, J, 3)."""
        published = {"interaction 0.01": {"density": "interaction", "noise": 0.01}}
        draws = self.mixed(published, 1).draws("interaction 0.01, repeat 0", "tempered-pairs")
        if draws is None:
            raise RuntimeError("the draws of interaction coordinates failed; see the message above")
        return step_by_step(draws)


def annotations(study: MixedStudy) -> pd.DataFrame:
    """Return annotations embedded by the interaction distance of their pictures (figure 5)."""
    annotated = study.drawn_annotations(0).annotations
    keypoints = evenly(annotated.keypoints, 30 if study.quick else 150)
    first, second = np.triu_indices(len(keypoints), 1)
    distances = np.zeros((len(keypoints), len(keypoints)))
    distances[first, second] = interaction_distance(keypoints[first], keypoints[second])
    points = classical_scaling(distances + distances.T)
    draw_map(points, keypoints, study.out / "figure5.png")
    return pd.DataFrame({"x": points[:, 0], "y": points[:, 1]})


def draw_map(points: np.ndarray, keypoints: np.ndarray, path: Path) -> None:
    """Plot embedded annotations (n, J, 2), with pictures of those that are far from each other."""
    width, height = np.ptp(points, axis=0)
    figure = Figure(figsize=(PAGE, PAGE * (height + 0.15 * width) / (1.15 * width)))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.scatter(*points.T, s=5.0, c=GREY)
    chosen = [0]
    for _ in range(24):
        away = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(axis=1)
        if away.max() < 0.09 * width:
            break
        chosen.append(int(away.argmax()))
    skeleton = Skeleton.preset("pair17")
    size = 0.09 * width / np.ptp(keypoints[chosen, :, 1], axis=1).mean()
    for index in chosen:
        pose = points[index] + size * (keypoints[index] - keypoints[index].mean(axis=0))
        for root, colour in zip(skeleton.roots, (LEFT, RIGHT), strict=True):
            bones = [
                pose[list(bone)] for bone in skeleton.bones if root in skeleton.ancestors(bone[0])
            ]
            axes.add_collection(LineCollection(bones, colors=colour, linewidths=0.9))
    axes.set_aspect("equal")
    axes.margins(0.08)
    axes.set_axis_off()
    finish_figure(figure, path)


def converged(study: MixedStudy) -> pd.DataFrame:
    """Return coverage by draws of parallel tempering, of held-out and of annotated pairs."""
    runs, rows = study.by_tempering, []
    if (draws := runs.draws("interaction 0.01, repeat 0", "tempered-pairs")) is not None:
        sets = {"real": evenly(study.held_out, 150), "posterior": evenly(step_by_step(draws), 200)}
        embed(sets | {"seed": study.seed_pose[None]}, study.out / "figure8.png")
    for run in runs.comparison.results:
        row = dict(runs.settings[run.problem])
        draws = runs.draws(run.problem, run.sampler)
        if draws is None:
            rows.append(row | {"failed": str(run.failure)})
            continue
        if "n_views" in row:
            row["density"] = f"{row['density']}, {row['n_views']} views"
        annotated = evenly(study.drawn_annotations(row["repeat"]).positions, study.n_held_out)
        poses = step_by_step(draws)
        row |= {name: run.metrics[name] for name in ("rhat", "seconds")}
        for measure in MEASURES:
            for pairs, truth in (("held-out", study.held_out), ("annotated", annotated)):
                value = float(coverage(truth, poses, measure))
                rows.append({"measure": measure, "pairs": pairs, "coverage": value, **row})
    return pd.DataFrame(rows)


def retrieval(study: MixedStudy) -> pd.DataFrame:
    """Return errors in 3D of pairs found for held-out annotations (figures 10 and 11), metres.

    Lifted pairs have valid joint angles. Naive samples are a thousand of those around the lifted
    pair. Of these, and of the draws of parallel tempering, the nearest to the annotation is found.
    """
    states, skeleton = study.states, Skeleton.preset("pair17")
    prior = study.posterior().prior
    frames = [dance_frames(clip) for clip in study.clips[1]]
    test = draw_annotations(study.clips[1], 8 if study.quick else 60, SEED, frames=frames)
    views = annotation_views(test.annotations, study.seed_pose)
    rows: list[dict[str, object]] = []
    pictures: dict[str, list[np.ndarray]] = {}
    every = np.ones(skeleton.n_joints, dtype=bool)
    for index, (keypoints, view) in enumerate(zip(test.annotations.keypoints, views, strict=True)):
        around = views_around(view)
        lifted = lift_people(keypoints, every, study.seed_pose, skeleton, view)
        naive = samples_around(lifted, prior, seeds.generator(SEED, "naive", index))
        found = {"lifting": lifted}
        for name, poses in (("naive", naive), ("draws", states)):
            nearest = retrieve(keypoints, poses, skeleton, views=around)
            found[name] = poses[int(nearest.indices[0])]
        truth = test.positions[index]
        pictures.setdefault("annotation", []).append(keypoints)
        side = view + np.array([np.pi / 2, 0.0])
        for name, pose in {"truth": truth, **found}.items():
            pictures.setdefault(f"{name},\nfrom the side", []).append(seen_from(side, pose))
        for name, pose in found.items():
            error = np.linalg.norm(align_rigidly(pose, truth) - truth, axis=-1).mean()
            rows.append({"method": name, "pair": index, "error": error})
    images_of = {label: np.stack(images) for label, images in pictures.items()}
    draw_pairs(images_of, skeleton, study.out / "figure10.png", columns=4)
    draw_nearest(study, evenly(states, 4)[:4])
    return pd.DataFrame(rows)


def seen_from(view: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return a pair (J, 3) with x to the right, y up and no depth in a view (2,), for pictures."""
    image = project_to_views(pose[None], view[None], Skeleton.preset("pair17"))[0, 0]
    return np.pad(image, ((0, 0), (0, 1)))


def samples_around(
    lifted: np.ndarray, prior: PosePairPrior, rng: np.random.Generator
) -> np.ndarray:
    """Return the most plausible 1000 of 4000 pairs around a lifted one, with its bone lengths."""
    theta = np.repeat(prior.coordinates(lifted)[None], 4000, axis=0)
    spread = np.full(prior.dim, 0.1)  # radians and metres
    spread[6 * len(prior.skeleton.roots) + 2 :: 3] = 0.0
    poses = prior.motion(theta + spread * rng.standard_normal(theta.shape))
    order = np.argsort(-prior.log_plausibility(poses), kind="stable")
    return poses[order[:1000], 0]


def draw_nearest(study: Study, poses: np.ndarray) -> None:
    """Plot pairs in the views in which annotations are nearest, with these (figure 11)."""
    skeleton = Skeleton.preset("pair17")
    annotated = study.drawn_annotations(0).annotations
    pairs, near = [], []
    for pose in poses:
        found = retrieve(annotated.keypoints, pose[None], skeleton)
        nearest = np.argsort(found.distances[:, 0], kind="stable")[:3]
        pairs.append(seen_from(found.views[nearest[0], 0], pose))
        near.append(annotated.keypoints[nearest])
    labels = ("nearest\nannotation", "second", "third")
    rows = {"draw": np.array(pairs), **dict(zip(labels, np.swapaxes(near, 0, 1), strict=True))}
    draw_pairs(rows, skeleton, study.out / "figure11.png", columns=4)


def completion(study: MixedStudy) -> pd.DataFrame:
    """Return image-plane errors of occluded joints of held-out pairs by method, metres (figure 12).

    All methods but the nearest annotation use the same estimate of the view, from the torsos.
    """
    frames = [dance_frames(clip) for clip in study.clips[1]]
    n = 10 if study.quick else 60
    test = draw_annotations(study.clips[1], n, SEED, frames=frames, hidden=0.3)
    complete = draw_annotations(study.clips[1], n, SEED, frames=frames)
    annotated = study.drawn_annotations(0).annotations
    skeleton = annotated.skeleton
    views = annotation_views(test.annotations, study.seed_pose)
    rows = []
    pictures: dict[str, list[np.ndarray]] = {}
    for index in range(n):
        keypoints, visible = test.annotations.keypoints[index], test.annotations.visible[index]
        truth = complete.annotations.keypoints[index]
        view = views[index]
        if np.isnan(view).any():  # too few torso joints are visible
            continue
        lifted = lift_people(keypoints, visible, study.seed_pose, skeleton, view)
        seed = project_to_views(study.seed_pose[None], view[None], skeleton)[0, 0]
        completed = {
            "nearest annotation": nearest_annotation_completion(
                keypoints, visible, annotated.keypoints, skeleton
            ).positions,
            "single-pose lifting": lifted[:, :2],
            "the seed": np.asarray(align_rigidly(seed, keypoints, visible)),
            "draws": complete_keypoints(
                keypoints, visible, study.states, skeleton, views=views_around(view)
            ).positions,
        }
        shown = {
            "occluded": np.where(visible[:, None], keypoints, np.nan),
            "completed\nfrom draws": completed["draws"],
            "lifted": completed["single-pose lifting"],
            "truth": truth,
        }
        for label, points in shown.items():
            pictures.setdefault(label, []).append(points)
        for name, positions in completed.items():
            error = occluded_joint_error(truth, positions, ~visible)
            rows.append({"method": name, "pair": index, "error": error})
    images_of = {label: np.stack(images) for label, images in pictures.items()}
    draw_pairs(images_of, skeleton, study.out / "figure12.png", columns=4)
    return pd.DataFrame(rows)


PARTS: dict[str, Callable[[MixedStudy], pd.DataFrame]] = {
    "annotations": annotations,
    "converged": converged,
    "retrieval": retrieval,
    "completion": completion,
}


def shown(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """Return the printed table of a part: means over repeats and pairs."""
    if name == "annotations":
        return table.describe().round(4)
    if name in ("completion", "retrieval"):
        errors = table.pivot(index="pair", columns="method", values="error")
        above = errors.sub(errors["draws"], axis=0).agg(["mean", "sem"]).T
        parts = errors.agg(["count", "mean", "median", "sem"]).T, above.add_prefix("above draws, ")
        return pd.concat(parts, axis=1).round(4)
    settings = ["measure", "pairs", "noise"]
    wide = table.pivot_table("coverage", [*settings, "repeat"], "density")
    for other in wide.columns.drop("interaction"):
        wide[f"{other}, difference"] = wide[other] - wide["interaction"]
    means = wide.groupby(level=settings).agg(["mean", "sem"])
    means.columns = [" ".join(names).removesuffix(" mean") for names in means.columns]
    return means.round(4)


if __name__ == "__main__":
    main(__doc__, MixedStudy, PARTS, shown)

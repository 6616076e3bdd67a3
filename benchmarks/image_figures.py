"""Accuracy of reconstructions of made images: held-out poses, shapes, colours and views.

Poses are those of held-out clips, which the category's motion code does not reproduce exactly.
Coverages are those of joints relative to their middle, after scaling each draw to the truth, since
one image determines no size. ``*_without_colours``: masks alone; ``*_without_shapes``: bodies of
the mean surface; ``*_one_hypothesis``: the encoder's likeliest quarter turn alone;
``*_encoder``: its mean, without refinement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import probmotion.reconstruction.inference as inference
from probmotion import seeds
from probmotion.data.synthetic import animal_clips
from probmotion.models.bodies.turn_fit import fit_turns
from probmotion.models.images.category import Category
from probmotion.models.images.encoder_training import encoder_of
from probmotion.models.images.made_images import make_images
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.latent.turn_code import TurnCode
from probmotion.reconstruction.refinement import refine

SIZE, TANGENT = 128, 0.15
DRAWS = 200
ABLATED = 40  # images of each ablation

Figures = Iterator[tuple[str, float]]


class Examples:
    """Made images of held-out animals, with their joints and θ."""

    def __init__(self, data: Path | None, part: str, n: int) -> None:
        self.category = Category.load("quadruped")
        self.prior = SurfacePrior(self.category, np.array([TANGENT]))
        self.length = float(np.ptp(self.category.body.rest_positions[:, 2]))
        rng = seeds.generator(0, f"images {part}")
        code, skeleton = self.category.code, self.category.body.skeleton
        windows = []
        for clip in animal_clips(data)[part]:
            positions = clip.retarget(skeleton).resample(code.fps).positions
            last = len(positions) - code.frames
            windows += [positions[s : s + code.frames] for s in range(0, last + 1, 5)]
        chosen = rng.choice(len(windows), size=n, replace=n > len(windows))
        fit = fit_turns(self.category.body, np.array(windows)[chosen])
        theta = self.prior.initial(rng, n)
        theta[:, self.prior.layout.lengths] = fit.log_lengths / self.category.length_spread
        self.observations, self.joints, self.points = [], [], []
        for k in range(n):
            # A code whose only motion is the true one.
            true = TurnCode(fit.turns[k], np.zeros((code.dim, *fit.turns[k].shape)), code.fps)
            prior = SurfacePrior(replace(self.category, code=true), np.array([TANGENT]))
            made = make_images(prior, rng, 1, SIZE, theta[k : k + 1])
            self.observations.append(
                ImageObservation(made.mask, made.rgb, None, np.array([TANGENT]), np.eye(3)[None])
            )
            joints = prior.motion(made.theta)[0, 0]
            self.joints.append(joints)
            self.points.append(seen(joints))


def seen(joints: np.ndarray) -> np.ndarray:
    """Return the places of joints in the image, pixels."""
    x, y, z = np.moveaxis(joints * [1.0, -1.0, -1.0], -1, 0)
    return 0.5 * SIZE * (1 + np.stack([x, y], axis=-1) / (z[..., None] * TANGENT))


def scaled(joints: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return joints (…, J, 3) relative to their middle, in the size of the truth (J, 3)."""
    joints = joints - joints.mean(axis=-2, keepdims=True)
    truth = truth - truth.mean(axis=0)
    # The ratio of sizes: that of least squares would shrink bodies that face elsewhere.
    size = np.sqrt((truth**2).sum() / (joints**2).sum(axis=(-1, -2)))
    return np.asarray(size[..., None, None] * joints)


def measured(examples: Examples, suffix: str = "", **changes: Any) -> Figures:
    """Yield the figures of reconstructions of all images."""
    rows, inside = [], []
    observations = examples.observations[: ABLATED if suffix else None]
    category = changes.get("category", examples.category)
    network = encoder_of(examples.category)
    for number, observation in enumerate(observations):
        truth = examples.joints[number]
        if not changes.get("colours", True):
            observation = replace(observation, rgb=None)
        prior = SurfacePrior(category, observation.tangent)
        if "hypotheses" in changes:
            rng = seeds.generator(0, "starts")
            starts = inference.encoded(network, prior, observation, rng, 0)
            modes = refine(prior, observation, starts[:1])
        else:
            modes = inference.posterior_modes(network, prior, observation, 0)
        theta = modes[0].theta
        joints = prior.motion(theta)[0]
        centred = truth - truth.mean(axis=0)
        error = np.linalg.norm(scaled(joints, truth) - centred, axis=-1).mean()
        points = examples.points[number]
        near = 0.1 * np.ptp(points, axis=0).max()
        correct = np.linalg.norm(seen(joints) - points, axis=-1) < near
        rows.append((overlap(prior, theta, observation), correct.mean(), error / examples.length))
        draws = inference.mixture_draws(modes, seeds.generator(number, "draws"), DRAWS)
        low, high = np.quantile(scaled(prior.motion(draws)[:, 0], truth), (0.05, 0.95), axis=0)
        inside.append(((centred >= low) & (centred <= high)).mean())
    names = ("mask_iou", "pck_01", "joint_error_share_of_length")
    values = np.array(rows)
    for name, column in zip(names, values.T, strict=True):
        yield name + suffix, float(column.mean())
        yield f"{name}{suffix}_error", float(column.std(ddof=1) / np.sqrt(len(column)))
    yield "coverage_90" + suffix, float(np.mean(inside))


def overlap(prior: SurfacePrior, theta: np.ndarray, observation: ImageObservation) -> float:
    """Return the intersection over union of silhouette and mask, over known pixels."""
    with torch.no_grad():
        images = prior.render(torch.as_tensor(theta[None], dtype=torch.float32), SIZE)
    mask = observation.mask[0]
    known, inside = np.isfinite(mask), np.nan_to_num(mask) >= 0.5
    covered = (images[0, 0, ..., 3].numpy() >= 0.5) & known
    return float((covered & inside).sum() / (covered | inside).sum())


def image_figures(data: Path | None, part: str, n: int, ablations: bool) -> Figures:
    """Yield all figures of ``n`` images of clips of a part of the split."""
    examples = Examples(data, part, n)
    network, prior = encoder_of(examples.category), examples.prior
    feed_forward = [
        overlap(
            prior, inference.encoded(network, prior, each, np.random.default_rng(0), 0)[0], each
        )
        for each in examples.observations
    ]
    yield "mask_iou_encoder", float(np.mean(feed_forward))
    yield from measured(examples)
    if ablations:
        yield from measured(examples, "_without_colours", colours=False)
        flat = replace(examples.category, shapes=1e-6 * examples.category.shapes)
        yield from measured(examples, "_without_shapes", category=flat)
        yield from measured(examples, "_one_hypothesis", hypotheses=1)

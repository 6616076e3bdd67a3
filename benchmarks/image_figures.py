"""Accuracy of reconstructions of made images: held-out poses, shapes, colours and views.

Poses are those of held-out clips, which the category's motion code does not reproduce exactly;
bodies, light and views are drawn from the category. Joints are relative to their middle, in the
size of the truth, since images determine no size; those of ``pck_01`` are in the image.
``mask_iou_encoder``: the encoder's mean, without refinement. ``flagged``: share that checks of
reconstructions flag, ``flagged_shapes`` that of masks of no body, and ``flagged_second`` that of
images with a smaller second body, refused ones included. ``direction_missed``: share
of images with fewer than one draw in twenty within 30° of the direction that the body faces.
``*_error``: standard errors.

``*_without_colours``: masks alone; ``*_without_shapes``: bodies of the mean surface;
``*_one_hypothesis``: starts in the encoder's likeliest quarter turn, and their mirror images;
``*_with_features``: with made features of the surface; ``*_without_motion_prior``: bone rotations
that are independent of one another, with the spreads of the motion code.

``transfer_pck_01``: keypoints of an image that the reconstructed surface transfers to another image
of another body, within a tenth of its size (*Ponymation*, section 4.2.2).

``clip_*``: clips of as many images as the motion code has frames. ``clip_velocity_error`` is that
of the same section, in the plane of the image; ``clip_velocity_error_3d`` is the same with the
depth. A body that does not move has error 1. ``clip_speed_ratio``: mean speed of joints over the
true one. ``clip_*_images_alone``: each image reconstructed without the others;
``clip_*_of_code``: the true motion as far as the motion code reproduces it, without images.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from keypoint_transfer import View
from made_bodies import SIZE, TANGENT, Bodies, Example, impossible_masks, with_second

import probmotion.reconstruction.inference as inference
from probmotion import seeds
from probmotion.metrics.keypoints import velocity_error
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.latent.turn_code import TurnCode
from probmotion.reconstruction import Reconstruction
from probmotion.reconstruction.refinement import Mode

DRAWS = 200
ABLATED = 40  # images of each ablation
TWO = 27  # bodies of whose images those with two are made
# Angle from the true direction, and share of draws within it below which the direction is missed.
NEAR, MISSED = np.radians(30.0), 0.05
ABLATIONS = (
    "_without_colours",
    "_without_shapes",
    "_one_hypothesis",
    "_with_features",
    "_without_motion_prior",
)

Figures = Iterator[tuple[str, float]]


def found(
    bodies: Bodies, observation: ImageObservation, suffix: str
) -> tuple[SurfacePrior, list[Mode]]:
    """Return the modes of the posterior, with or without a part of it, and their prior."""
    category = bodies.featured if suffix == "_with_features" else bodies.category
    if suffix != "_with_features":
        observation = replace(observation, features=None)
    if suffix == "_without_colours":
        observation = replace(observation, rgb=None)
    if suffix == "_without_shapes":
        category = replace(category, shapes=1e-6 * category.shapes)
    prior = SurfacePrior(category, observation.tangent)
    if suffix not in ("_one_hypothesis", "_without_motion_prior"):
        return prior, inference.posterior_modes(bodies.network, prior, observation)
    rng = seeds.generator(0, "starts")
    likely, drawn = inference.encoded(bodies.network, prior, observation, rng, inference.DRAWN)
    if suffix == "_one_hypothesis":
        likely = likely[:1]
    else:
        _, drawn = independent(prior, drawn)
        prior, likely = independent(prior, likely)
    return prior, inference.modes_of(prior, observation, likely, drawn)


def independent(prior: SurfacePrior, theta: np.ndarray) -> tuple[SurfacePrior, np.ndarray]:
    """Return a prior of one image with independent bone rotations, and θ of the same bodies."""
    code, at = prior.category.code, prior.layout.code
    mean = code.turns(np.zeros(code.dim))[:1]
    spread = np.linalg.norm(code.turns(np.eye(code.dim))[:, 0] - mean[0], axis=0)
    basis = np.diag(spread.ravel()).reshape(-1, *mean.shape)
    z = ((code.turns(theta[:, at])[:, 0] - mean[0]) / spread).reshape(len(theta), -1)
    category = replace(prior.category, code=TurnCode(mean, basis, code.fps))
    return SurfacePrior(category, prior.tangent), np.hstack([z, theta[:, at.stop :]])


def seen(joints: np.ndarray) -> np.ndarray:
    """Return the places of joints in the image, pixels."""
    x, y, z = np.moveaxis(joints * [1.0, -1.0, -1.0], -1, 0)
    return 0.5 * SIZE * (1 + np.stack([x, y], axis=-1) / (z[..., None] * TANGENT))


def scaled(joints: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return joints (…, J, 3) relative to their middle, in the size of the truth (…, J, 3)."""
    joints = joints - joints.mean(axis=-2, keepdims=True)
    truth = truth - truth.mean(axis=-2, keepdims=True)
    # The ratio of sizes: that of least squares would shrink bodies that face elsewhere.
    size = np.sqrt((truth**2).sum(axis=(-1, -2)) / (joints**2).sum(axis=(-1, -2)))
    return np.asarray(size[..., None, None] * joints)


def joint_errors(joints: np.ndarray, truth: np.ndarray, length: float) -> dict[str, float]:
    """Return errors of joints (T, J, 3), and of their velocities if there are several images."""

    def points(joints: np.ndarray) -> np.ndarray:
        """Return points of the plane (T, 2 J, 2) that move as far as the joints in space."""
        return np.concatenate([joints[..., :2], joints[..., 1:] * [0.0, 1.0]], axis=1)

    joints, truth = scaled(joints, truth), scaled(truth, truth)
    error = float(np.linalg.norm(joints - truth, axis=-1).mean() / length)
    if len(truth) == 1:
        return {"joint_error_share_of_length": error}
    speeds = [np.linalg.norm(np.diff(each, axis=0), axis=-1).mean() for each in (joints, truth)]
    return {
        "joint_error_share_of_length": error,
        "velocity_error": velocity_error(joints[..., :2], truth[..., :2]),
        "velocity_error_3d": velocity_error(points(joints), points(truth)),
        "speed_ratio": float(speeds[0] / speeds[1]),
    }


def overlaps(prior: SurfacePrior, theta: np.ndarray, observation: ImageObservation) -> float:
    """Return the mean intersection over union of silhouettes and masks, over known pixels."""
    with torch.no_grad():
        images = prior.render(torch.as_tensor(theta[None], dtype=torch.float32), SIZE)
    known, inside = np.isfinite(observation.mask), np.nan_to_num(observation.mask) >= 0.5
    covered = (images[0, ..., -1].numpy() >= 0.5) & known
    both, either = (covered & inside).sum(axis=(1, 2)), (covered | inside).sum(axis=(1, 2))
    return float((both / either).mean())


class Estimate(NamedTuple):
    """Joints (T, J, 3) and vertices (T, V, 3) of a reconstruction, with axes as in examples.

    ``draws`` (n, T, J, 3) are joints, and ``yaws`` (n,) directions that they face in the first
    image; ``mask_iou`` is a mean over images; ``flagged`` is the share of reconstructions that a
    check flags.
    """

    joints: np.ndarray
    vertices: np.ndarray
    draws: np.ndarray
    yaws: np.ndarray
    mask_iou: float
    flagged: float


def reconstructed(
    bodies: Bodies, observation: ImageObservation, suffix: str, seed: int
) -> Estimate:
    """Return the reconstruction of an image or clip."""
    if suffix == "_images_alone":
        alone = [
            reconstructed(bodies, image_of(observation, t), "", seed)
            for t in range(observation.images)
        ]
        joints, vertices, draws, facing, shares, failed = zip(*alone, strict=True)
        return Estimate(
            np.concatenate(joints),
            np.concatenate(vertices),
            np.concatenate(draws, axis=1),
            facing[0],
            float(np.mean(shares)),
            float(np.mean(failed)),
        )
    prior, modes = found(bodies, observation, suffix)
    theta, images = modes[0].theta, observation.images
    drawn = inference.mixture_draws(modes, seeds.generator(seed, "draws"), DRAWS)
    return Estimate(
        prior.motion(theta)[:images],
        prior.vertices(torch.as_tensor(theta[None]))[0].numpy(),
        prior.motion(drawn)[:, :images],
        prior.yaw(drawn),
        overlaps(prior, theta, observation),
        flagged(prior, modes, drawn, observation),
    )


def flagged(
    prior: SurfacePrior, modes: list[Mode], draws: np.ndarray, observation: ImageObservation
) -> float:
    """Return 1 if a check flags the reconstruction, else 0."""
    # The checks do not depend on features, which the category may not have.
    observed = replace(observation, features=None)
    result = Reconstruction(observed, prior, modes[0].theta, draws, ())
    return float(not inference.checked(result).trusted)


def of_shapes(bodies: Bodies) -> Figures:
    """Yield the share of reconstructions of masks of no body that a check flags."""
    rows = []
    for number, mask in enumerate(impossible_masks()):
        observation = ImageObservation(mask[None], None, None, np.array([TANGENT]), np.eye(3)[None])
        rows.append({"flagged": reconstructed(bodies, observation, "", number).flagged})
    yield from means(rows, "_shapes")


def of_two_bodies(bodies: Bodies, n: int) -> Figures:
    """Yield the share of images with a smaller second body that are refused or flagged.

    They are of those of the first ``n`` bodies that are not cut off.
    """
    alone = [bodies.image(number).observation for number in range(n)]
    alone = [observation for observation in alone if not observation.truncated.any()]
    rows = []
    for number, (first, second) in enumerate(zip(alone, alone[1:] + alone[:1], strict=True)):
        try:
            both = with_second(first, second)
        except ValueError:
            rows.append({"flagged": 1.0})
            continue
        rows.append({"flagged": reconstructed(bodies, both, "", number).flagged})
    yield from means(rows, "_second")


def errors_of(estimate: Estimate, example: Example, length: float) -> dict[str, float]:
    """Return the figures of one reconstruction."""
    truth = example.joints
    near = 0.1 * np.ptp(seen(truth), axis=1).max(axis=1, keepdims=True)
    correct = np.linalg.norm(seen(estimate.joints) - seen(truth), axis=-1) < near
    centred = scaled(truth, truth)
    low, high = np.quantile(scaled(estimate.draws, truth), (0.05, 0.95), axis=0)
    return {
        "mask_iou": estimate.mask_iou,
        "flagged": estimate.flagged,
        "pck_01": float(correct.mean()),
        "coverage_90": float(((centred >= low) & (centred <= high)).mean()),
        "direction_missed": direction_missed(estimate.yaws, example.yaw),
        **joint_errors(estimate.joints, truth, length),
    }


def direction_missed(draws: np.ndarray, truth: float) -> float:
    """Return 1 if fewer than one direction in twenty is within 30° of the truth, else 0."""
    return float((np.cos(draws - truth) > np.cos(NEAR)).mean() < MISSED)


def transfers(bodies: Bodies, examples: list[Example], estimates: list[Estimate]) -> list[float]:
    """Return the shares of keypoints that each first image transfers correctly to the next one."""
    views = []
    for example, estimate in zip(examples, estimates, strict=True):
        surface = replace(bodies.category.surface, vertices=estimate.vertices[0])
        joints = example.joints[0] * [1.0, -1.0, -1.0]
        mask = example.observation.mask[0]
        views.append(View.of(joints, example.vertices[0], surface, mask, TANGENT))
    pairs = zip(views, views[1:] + views[:1], strict=True)
    shares = [view.transferred(other) for view, other in pairs]
    return [share for share in shares if np.isfinite(share)]


def image_of(observation: ImageObservation, t: int) -> ImageObservation:
    """Return one image of a clip."""
    own: dict[str, Any] = {}
    for name in ("mask", "rgb", "features", "tangent", "rotation"):
        array = getattr(observation, name)
        own[name] = None if array is None else array[t : t + 1]
    return replace(observation, **own)


def measured(bodies: Bodies, examples: Iterable[Example], suffix: str = "") -> Figures:
    """Yield the figures of reconstructions of images, or of clips."""
    examples = list(examples)
    estimates = [
        reconstructed(bodies, example.observation, suffix, number)
        for number, example in enumerate(examples)
    ]
    pairs = zip(estimates, examples, strict=True)
    rows = [errors_of(estimate, example, bodies.length) for estimate, example in pairs]
    yield from means(rows, suffix)
    if examples[0].observation.images == 1:
        shares = transfers(bodies, examples, estimates)
        yield from means([{"transfer_pck_01": share} for share in shares], suffix)


def of_code(bodies: Bodies, n: int) -> Figures:
    """Yield errors of the motions of the code that are closest to those of ``n`` bodies."""
    rows = []
    for number in range(n):
        closest = bodies.clip(number, bodies.reproduced(number))
        rows.append(joint_errors(closest.joints, bodies.clip(number).joints, bodies.length))
    yield from means(rows, "_of_code")


def of_encoder(bodies: Bodies, n: int) -> Figures:
    """Yield the overlap of the encoder's likeliest bodies with the masks."""
    rows = []
    for number in range(n):
        observation = bodies.image(number).observation
        prior = SurfacePrior(bodies.category, observation.tangent)
        rng = np.random.default_rng(0)
        theta = inference.encoded(bodies.network, prior, observation, rng, 0)[0][0]
        rows.append({"mask_iou": overlaps(prior, theta, observation)})
    yield from means(rows, "_encoder")


def means(rows: list[dict[str, float]], suffix: str) -> Figures:
    """Yield the mean and standard error of every figure."""
    for name in rows[0]:
        values = [row[name] for row in rows]
        yield name + suffix, float(np.mean(values))
        yield f"{name}{suffix}_error", float(np.std(values, ddof=1) / np.sqrt(len(values)))


def image_figures(
    name: str, data: Path | None, part: str, images: int, clips: int, ablations: bool
) -> Figures:
    """Yield all figures of a category; names are preceded by that of ``person``."""
    bodies = Bodies(name, data, part, max(images, clips))

    def of_images(n: int, suffix: str = "") -> Figures:
        return measured(bodies, map(bodies.image, range(n)), suffix)

    def of_clips(suffix: str = "") -> Figures:
        return measured(bodies, map(bodies.clip, range(clips)), suffix)

    single = [
        of_encoder(bodies, images),
        of_shapes(bodies),
        of_two_bodies(bodies, min(images, TWO)),
        of_images(images),
    ]
    parts = {"": single, "clip_": []}
    if ablations:
        parts[""] += [of_images(min(images, ABLATED), suffix) for suffix in ABLATIONS]
    if clips:
        parts["clip_"] = [of_code(bodies, clips), of_clips(), of_clips("_images_alone")]
    before = "" if name == "quadruped" else f"{name}_"
    for prefix, figures in parts.items():
        for figure, value in itertools.chain.from_iterable(figures):
            yield before + prefix + figure, value

"""Made images of bodies in motions of held-out clips, and their joints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from probmotion import seeds
from probmotion.data.synthetic import animal_clips, walk_clips
from probmotion.models.bodies.turn_fit import fit_turns
from probmotion.models.images.category import Category
from probmotion.models.images.encoder_training import encoder_of
from probmotion.models.images.made_images import (
    MARGIN,
    in_front,
    make_images,
    with_made_features,
)
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import _PITCH, _ROLL, SurfacePrior
from probmotion.models.latent.turn_code import TurnCode

SIZE, TANGENT = 128, 0.15
PASSES = 3  # of moving a body into the middle
SMALLER, OVERLAP = 0.45, 4  # size of a second body, and pixels by which it overlaps with the first


class Example(NamedTuple):
    """Images (T) of a body, its joints (T, J, 3) and its surface (T, V, 3), metres.

    Joints have Y up and Z towards the camera, vertices y down and z forward. The body faces at
    ``yaw`` in the first image, as of ``SurfacePrior.yaw``.
    """

    observation: ImageObservation
    joints: np.ndarray
    vertices: np.ndarray
    yaw: float


class Bodies:
    """Bodies of a category in motions of held-out clips.

    Rotations of all ``n`` bodies are fitted with common bone lengths, so that images of a body
    depend slightly on their number.
    """

    def __init__(self, name: str, data: Path | None, part: str, n: int) -> None:
        self.category = Category.load(name)
        self.featured = with_made_features(self.category)
        self.network = encoder_of(self.category)
        self.part = part
        body, code = self.category.body, self.category.code
        self.length = float(np.ptp(body.rest_positions, axis=0).max())
        windows = []
        if name == "person" and data is None:
            raise ValueError("data must be the folder with the real motions of people, got none")
        clips = walk_clips(data) if data and name == "person" else animal_clips(data)
        for clip in clips[part]:
            positions = clip.retarget(body.skeleton).resample(code.fps).positions
            last = len(positions) - code.frames
            windows += [positions[s : s + code.frames] for s in range(0, last + 1, 5)]
        order = seeds.generator(0, f"windows {part}").permutation(len(windows))
        self.fit = fit_turns(body, np.array(windows)[np.resize(order, n)])

    def image(self, number: int) -> Example:
        """Return an image of the first frame of a body's motion, which may be cut off."""
        rng, prior, theta = self._posed(number, self.fit.turns[number, :1])
        made = make_images(prior, rng, 1, SIZE, theta)
        return _example(prior, made.theta, made.mask, made.rgb, made.features)

    def clip(self, number: int, turns: np.ndarray | None = None) -> Example:
        """Return images of a body's motion, or of other bone rotations (T, B, 3).

        The camera moves with the body without turning, such that the middle of its trunk is at one
        place, and all of the body is in all images. Masks have no errors.
        """
        rng, prior, theta = self._posed(number, self.fit.turns[number] if turns is None else turns)
        for _ in range(PASSES):
            points = prior.vertices(torch.as_tensor(theta))[:, 0].numpy()
            points = points[..., :2] / (points[..., 2:] * TANGENT)
            low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
            middle, half = 0.5 * (low + high), 0.5 * MARGIN * (high - low).max()
            n = len(theta)
            theta = prior.moved(theta, np.tile(-middle, (n, 1)), np.full(n, half))
        with torch.no_grad():
            rows = torch.as_tensor(theta, dtype=torch.float32)
            images = prior.render(rows, SIZE, True)[:, 0].numpy()
        mask = images[..., -1].clip(0.0, 1.0)
        features = images[..., 3:-1] / np.maximum(mask, 0.05)[..., None]
        return _example(prior, theta, mask, in_front(images, rng), features)

    def _posed(
        self, number: int, turns: np.ndarray
    ) -> tuple[np.random.Generator, SurfacePrior, np.ndarray]:
        """Return a prior of one image and θ (T, dim) of a body with bone rotations (T, B, 3).

        The view of the first image is drawn; the body then rotates as in its motion.
        """
        rng, frames = seeds.generator(number, f"images {self.part}"), len(turns)
        # A code that has only these poses: z is 1 for one of them and 0 for the others.
        code = TurnCode(np.zeros((1, *turns.shape[1:])), turns[:, None], self.category.code.fps)
        prior = SurfacePrior(replace(self.featured, code=code), np.array([TANGENT]))
        theta = np.tile(prior.initial(rng, 1), (frames, 1))
        theta[:, prior.layout.code] = np.eye(frames)
        theta[:, prior.layout.lengths] = self.fit.log_lengths[number] / self.category.length_spread
        first = prior.parameters(torch.as_tensor(theta[:1])).rotation[0, 0].numpy()
        rotation = self.fit.rotation[number, :frames]
        return rng, prior, rotated(prior, theta, first @ rotation[0].T @ rotation)

    def reproduced(self, number: int) -> np.ndarray:
        """Return the bone rotations (L, B, 3) of the code that are closest to a body's motion."""
        code, true = self.category.code, self.fit.turns[number]
        mean = code.turns(np.zeros(code.dim))
        basis = (code.turns(np.eye(code.dim)) - mean).reshape(code.dim, -1)
        z = np.linalg.lstsq(basis.T, (true - mean).ravel(), rcond=None)[0]
        return np.asarray(code.turns(z))


def impossible_masks() -> list[np.ndarray]:
    """Return masks (SIZE, SIZE) of shapes that no body has, such as a disc or a star."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / (0.4 * SIZE) - 1.25  # -1 to 1 inside the crop
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    shapes = [
        radius < 1,
        np.maximum(np.abs(x), np.abs(y)) < 0.8,
        np.abs(x) + np.abs(y) < 1,
        np.hypot(x, 2 * y) < 1,
        np.hypot(2 * x, y) < 1,
        (y < 0.8) & (np.abs(x) < 0.5 * (y + 0.8)),
        radius < 0.65 + 0.35 * np.cos(3 * angle),
        radius < 0.65 + 0.35 * np.cos(5 * angle),
        (np.minimum(np.abs(x), np.abs(y)) < 0.3) & (radius < 1),
        (radius > 0.6) & (radius < 1) & (x < 0.3),
    ]
    return [shape.astype(float) for shape in shapes]


def with_second(first: ImageObservation, second: ImageObservation) -> ImageObservation:
    """Return an image of a body with a smaller one to its right.

    It has about a fifth of the area and stands as low in the image. Raises ``ValueError`` if the
    mask is refused.
    """
    side = 3 * SIZE
    mask, rgb = np.zeros((side, side)), np.full((side, side, 3), 0.5)
    corner = np.array([SIZE, SIZE])  # row and column of the first body's crop
    smaller = (np.arange(round(SMALLER * SIZE)) / SMALLER).astype(int)
    low, right = corner + last_pixel(first)
    other = np.array([low, right - OVERLAP]) - SMALLER * np.array(
        [last_pixel(second)[0], np.flatnonzero((second.mask[0] >= 0.5).any(axis=0))[0]]
    )
    for seen, (top, left), pixels in (
        (second, other.astype(int), smaller),
        (first, corner, np.arange(SIZE)),
    ):
        place = (slice(top, top + len(pixels)), slice(left, left + len(pixels)))
        part = np.nan_to_num(seen.mask[0][np.ix_(pixels, pixels)])
        covered = part >= 0.5
        mask[place] = np.maximum(mask[place], part)
        rgb[place][covered] = seen.rgb[0][np.ix_(pixels, pixels)][covered]
    fov = np.degrees(2 * np.arctan(3 * TANGENT))
    return ImageObservation.read(rgb, mask, fov=float(fov))


def last_pixel(observation: ImageObservation) -> np.ndarray:
    """Return the last row and column of the body in an image."""
    body = observation.mask[0] >= 0.5
    return np.array([np.flatnonzero(body.any(axis=axis))[-1] for axis in (1, 0)])


def rotated(prior: SurfacePrior, theta: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return θ (n, dim) of one image with rotations (n, 3, 3) from body to camera axes."""
    angles = Rotation.from_matrix(rotation @ np.diag([1.0, -1.0, -1.0])).as_euler("ZXY")
    roll, pitch, yaw = angles.T
    turned, start = prior.facing(theta, -yaw), prior.layout.view.start
    turned[:, start + 2] = (pitch - _PITCH[0]) / _PITCH[1]
    turned[:, start + 3] = (roll - _ROLL[0]) / _ROLL[1]
    return turned


def _example(
    prior: SurfacePrior,
    theta: np.ndarray,
    mask: np.ndarray,
    rgb: np.ndarray,
    features: np.ndarray | None,
) -> Example:
    cameras = np.full(len(theta), TANGENT), np.tile(np.eye(3), (len(theta), 1, 1))
    vertices = prior.vertices(torch.as_tensor(theta))[:, 0].numpy()
    observation = ImageObservation(mask, rgb, features, *cameras)
    return Example(observation, prior.motion(theta)[:, 0], vertices, float(prior.yaw(theta)[0]))

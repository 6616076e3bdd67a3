"""Result of a reconstruction."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from probmotion.extras import torch
from probmotion.files import written_together, written_whole
from probmotion.io.glb import write_glb
from probmotion.io.npz import write_npz
from probmotion.lifting.checks import Check
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.motion.motion import Motion
from probmotion.reconstruction.moving_surface import rig_motion, skinned_mesh
from probmotion.reconstruction.page import reconstruction_page
from probmotion.reconstruction.texture import textured
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["Reconstruction"]

_SHOWN, _ANIMATIONS = 5, 4  # draws on the page, and in the GLB
_SIDES, _DEPTHS = ("right", "left"), ("towards the camera", "away from the camera")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Posterior of a body given one image or the T images of a clip.

    Axes are right, up, and towards the camera, which is at the origin, in the first image's crop.

    Parameters
    ----------
    observation : ImageObservation
    prior : SurfacePrior
        Prior of θ for the observation's T crops.
    theta : ndarray, (dim,)
        Most probable mode.
    draws : ndarray, (n, dim)
        Posterior draws of θ, at least two.
    checks : tuple of Check
        Predictive checks.

    Raises
    ------
    ValueError
        If shapes disagree, a value is not finite, or the prior is of other crops.
    """

    observation: ImageObservation
    prior: SurfacePrior
    theta: np.ndarray
    draws: np.ndarray
    checks: tuple[Check, ...]

    def __post_init__(self) -> None:
        check_shape("theta", self.theta, (self.prior.dim,))
        check_shape("draws", self.draws, ("n", self.prior.dim))
        check_count("draws", len(self.draws), 2)
        check_finite("theta", self.theta)
        check_finite("draws", self.draws)
        self.prior.check_observations(self.observation)

    @cached_property
    def joints(self) -> np.ndarray:
        """Joints of the draws in the first image, (n, J, 3), metres."""
        joints: np.ndarray = self.prior.motion(self.draws)[:, 0]
        return joints

    @cached_property
    def sd(self) -> np.ndarray:
        """Posterior standard deviation of joints relative to their middle, (J,), metres.

        It is the root of the summed variances of the three axes.
        """
        relative = self.joints - self.joints.mean(axis=1, keepdims=True)
        sd: np.ndarray = np.sqrt(relative.var(axis=0, ddof=1).sum(axis=-1))
        return sd

    @cached_property
    def silhouette(self) -> np.ndarray:
        """Pixels of each image that the most probable body covers, (T, S, S), bool."""
        with torch.no_grad():
            rows = torch.as_tensor(self.theta[None], dtype=torch.float32)
            images = self.prior.render(rows, self.observation.size)[0]
        covered: np.ndarray = images[..., 3].numpy() >= 0.5
        return covered

    @property
    def mask_iou(self) -> float:
        """Intersection over union of the mode's silhouette and the mask, over known pixels."""
        mask = self.observation.mask
        inside, known = mask >= 0.5, np.isfinite(mask)
        both, either = self.silhouette & inside, (self.silhouette | inside) & known
        return float(both.sum() / either.sum())

    @property
    def facing(self) -> np.ndarray:
        """Direction that each draw faces in the first image, (n,), degrees.

        0 is towards the camera, 90 to the right of the image, and ±180 away.
        """
        directions: np.ndarray = np.degrees(self.prior.yaw(self.draws))
        return directions

    @property
    def trusted(self) -> bool:
        """Whether all checks passed."""
        return all(check.passed for check in self.checks)

    def with_checks(self, *checks: Check) -> Reconstruction:
        """Return the reconstruction with these checks."""
        return replace(self, checks=checks)

    def summary(self) -> list[str]:
        """Return three sentences: whether to trust it, how precise it is, what is left open."""
        failed = [check.problem for check in self.checks if not check.passed]
        name, images = self.prior.category.name, self.observation.images
        trust = f"A body of the category {name} explains the image{'s' if images > 1 else ''}."
        if failed:
            trust = f"Do not trust this reconstruction: {'; '.join(failed)}."
        if self.observation.truncated.any():
            trust += " A part of the body is beyond the border or hidden."
        precision = (
            f"The most probable body covers the mask with an intersection over union of "
            f"{self.mask_iou:.2f}, and joints have a standard deviation of "
            f"{1000 * np.median(self.sd):.0f} mm relative to the body's middle (largest joint: "
            f"{1000 * self.sd.max():.0f} mm)."
        )
        return [trust, precision, self._left_open()]

    def motion(self, draw: int) -> Motion:
        """Return the motion of a draw, with rotations, on the rig of the category's body.

        It starts with the images, at the frame rate of the category's motions; the first J joints
        are those of the category. Bones are exactly rigid.
        """
        motion = rig_motion(self.prior, self.draws[draw])
        return replace(motion, name=f"{self.prior.category.name} {draw}")

    def report(self, path: str | Path) -> Path:
        """Write an HTML page with the images, other views and draws in motion; return its path."""
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise ValueError(f"path must end in .html, got {str(path)!r}")
        # Equally many draws between those shown, by the direction that they face.
        facing = self.facing
        count = min(_SHOWN, len(facing))
        places = (len(facing) * (np.arange(count) + 0.5) / count).astype(int)
        shown = np.argsort(facing)[places]
        angles = np.radians(facing[shown])
        captions = [
            f"draw {draw}: faces {_or(side, *_SIDES)}, {_or(depth, *_DEPTHS)}"
            for draw, side, depth in zip(shown, np.sin(angles) > 0, np.cos(angles) > 0, strict=True)
        ]
        page = reconstruction_page(
            self.observation,
            self.prior,
            self.theta,
            dict(zip(captions, self.draws[shown], strict=True)),
            self.checks,
            self.summary(),
        )
        with written_whole(path) as unfinished:
            unfinished.write_text(page, encoding="utf-8")
        return path

    def save(self, folder: str | Path) -> None:
        """Write the page, the surface as GLB, all draws, and a summary.

        The files are ``reconstruct.html``, ``body.glb`` (body of the mode, with a texture, and one
        animation for each of the draws whose joints are closest to those of the mode),
        ``reconstruction.npz`` (the closest one's motion, θ of the mode and the draws, and the
        draws' joints), and ``summary.json``.
        """
        with written_together(Path(folder)) as unfinished:
            self._write(unfinished)

    def _write(self, folder: Path) -> None:
        """Write the files of :meth:`save`."""
        self.report(folder / "reconstruct.html")
        moving, name = self._moving(), self.prior.category.name
        motion, *others = (
            replace(rig_motion(self.prior, theta), name=f"{name} {number}")
            for number, theta in enumerate(moving)
        )
        mesh = skinned_mesh(self.prior, moving[0])
        mesh = textured(mesh, self.observation, self.prior, self.theta)
        write_glb(motion, folder / "body.glb", mesh, others)
        arrays = {"theta": self.theta, "draws": self.draws, "joints": self.joints}
        write_npz(motion, folder / "reconstruction.npz", arrays)
        content = {
            "trusted": self.trusted,
            "summary": self.summary(),
            "checks": {
                check.name: {"value": check.value, "limit": check.limit, "passed": check.passed}
                for check in self.checks
            },
            "category": self.prior.category.name,
            "images": self.observation.images,
            "mask_iou": self.mask_iou,
            "truncated": self.observation.truncated.tolist(),
            "facing_degrees": self.facing.tolist(),
            "sd_metres": dict(zip(self.prior.skeleton.joint_names, self.sd.tolist(), strict=True)),
        }
        (folder / "summary.json").write_text(json.dumps(content, indent=1), encoding="utf-8")

    def _moving(self) -> np.ndarray:
        """Return θ (n, dim) of the mode with motions and poses of the draws closest at first.

        Frames after the images are uncertain, and the mode moves less than any draw.
        """
        gaps = np.linalg.norm(self.joints - self.prior.motion(self.theta)[0], axis=-1).mean(axis=1)
        nearest = self.draws[np.argsort(gaps, kind="stable")[:_ANIMATIONS]]
        theta = np.tile(self.theta, (len(nearest), 1))
        for part in (self.prior.layout.code, self.prior.layout.view):
            theta[:, part] = nearest[:, part]
        return theta

    def _left_open(self) -> str:
        """Return the sentence on the directions that the draws face."""
        angles = np.radians(self.facing)
        sides = _or(np.sin(angles) > 0, *_SIDES)
        return f"The draws face {sides}, {_or(np.cos(angles) > 0, *_DEPTHS)}."


def _or(first: np.ndarray, one: str, other: str) -> str:
    """Return the words for draws of which some are the first, with their shares."""
    if first.all() or not first.any():
        return one if first.all() else other
    share = min(max(round(100 * float(first.mean())), 1), 99)
    return f"{one} ({share} %) or {other} ({100 - share} %)"

"""Result of a lift."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from probmotion.files import writable_folder, written_whole
from probmotion.geometry.cameras import Cameras
from probmotion.io.files import save
from probmotion.io.npz import write_npz
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.checks import Check
from probmotion.lifting.page import lift_page
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.motion import Motion

__all__ = ["Lift"]


@dataclass(frozen=True, eq=False)
class Lift:
    """Posterior of a person's motion given one camera's keypoints.

    The world's axes are the image's right, up, and towards the camera, which is at
    (0, ``camera_height``, 0); the floor is y = 0.

    Parameters
    ----------
    mean : Motion
        Posterior mean on ``person14``.
    draws : ndarray, (n, L, J, 3)
        Posterior draws, metres.
    camera : LevelCamera
        Focal length, principal point and pitch.
    camera_height : float
        Height of the camera above the floor, metres.
    noise : float
        Scale of the keypoints' noise, pixels.
    keypoints : ndarray, (L, J, 2)
        Keypoints that were used, pixels; 0 where missing.
    weight : ndarray, (L, J)
        Multiplier of their precision; 0 where missing.
    swapped : float
        Share of arms and legs whose sides were exchanged before lifting.
    checks : tuple of Check
        Predictive checks.
    """

    mean: Motion
    draws: np.ndarray
    camera: LevelCamera
    camera_height: float
    noise: float
    keypoints: np.ndarray
    weight: np.ndarray
    swapped: float
    checks: tuple[Check, ...]

    @cached_property
    def sd(self) -> np.ndarray:
        """Posterior standard deviation of positions relative to the root, (L, J, 3), metres."""
        deviation: np.ndarray = (self.draws - self.draws[:, :, :1]).std(axis=0, ddof=1)
        return deviation

    @property
    def cameras(self) -> Cameras:
        """The camera, as a batch of one."""
        right, up, forward = self.camera.axes
        rotation = np.stack([right, -up, forward])
        translation = -rotation @ [0.0, self.camera_height, 0.0]
        focal, centre = np.array([self.camera.focal]), np.array([self.camera.centre])
        return Cameras(rotation[None], translation[None], focal, centre, orthographic=False)

    @property
    def trusted(self) -> bool:
        """Whether all checks passed."""
        return all(check.passed for check in self.checks)

    def summary(self) -> list[str]:
        """Return three sentences: whether to trust the motion, how precise it is, the camera."""
        failed = [check.problem for check in self.checks if not check.passed]
        trust = "A person who moves like those of the prior explains the keypoints."
        if failed:
            trust = f"Do not trust this motion: {'; '.join(failed)}."
        spread = 1000 * np.sqrt((self.sd[:, 1:] ** 2).sum(axis=-1))
        precision = (
            f"Joints have a standard deviation of {np.median(spread):.0f} mm relative to the "
            f"pelvis (largest joint: {spread.mean(axis=0).max():.0f} mm), and keypoints a noise of "
            f"{self.noise:.1f} pixels."
        )
        distance = np.linalg.norm(self.mean.positions[:, 0, [0, 2]], axis=-1)
        camera = (
            f"The camera is {self.camera_height:.2f} m above the floor and looks "
            f"{abs(np.degrees(self.camera.pitch)):.0f}° {'up' if self.camera.pitch > 0 else 'down'}"
            f"; the person is {distance.min():.1f} to {distance.max():.1f} m away."
        )
        return [trust, precision, camera]

    def report(self, path: str | Path) -> Path:
        """Write an HTML page with the summary and the motion, and return its path."""
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise ValueError(f"path must end in .html, got {str(path)!r}")
        with written_whole(path) as unfinished:
            seen = np.where(self.weight[..., None] > 0, self.keypoints, np.nan)
            page = lift_page(self.mean, self.draws, self.cameras, seen, self.checks, self.summary())
            unfinished.write_text(page, encoding="utf-8")
        return path

    def save(self, folder: str | Path) -> None:
        """Write the page, the mean as BVH and GLB, all draws, and a summary to a folder.

        The files are ``lift.html``, ``lift.bvh``, ``lift.glb``, ``lift.npz`` (mean, standard
        deviations and draws) and ``summary.json``.
        """
        folder = Path(folder)
        writable_folder(folder)
        self.report(folder / "lift.html")
        rigid = rigid_motion(self.mean)
        save(rigid, folder / "lift.bvh")
        save(rigid, folder / "lift.glb")
        write_npz(self.mean, folder / "lift.npz", {"sd": self.sd, "draws": self.draws})
        content = {
            "trusted": self.trusted,
            "summary": self.summary(),
            "checks": {
                check.name: {"value": check.value, "limit": check.limit, "passed": check.passed}
                for check in self.checks
            },
            "camera": {
                "focal": self.camera.focal,
                "centre": list(self.camera.centre),
                "pitch_degrees": float(np.degrees(self.camera.pitch)),
                "height": self.camera_height,
            },
            "noise_pixels": self.noise,
            "swapped_share": self.swapped,
        }
        with written_whole(folder / "summary.json") as unfinished:
            unfinished.write_text(json.dumps(content, indent=1), encoding="utf-8")

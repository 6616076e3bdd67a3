"""Result of a lift."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from probmotion.files import written_together, written_whole
from probmotion.geometry.cameras import Cameras
from probmotion.io.files import save
from probmotion.io.npz import write_npz
from probmotion.io.smpl import smpl_motion
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.checks import Check
from probmotion.lifting.keypoints import ANKLES, LIMBS, from_hips
from probmotion.lifting.linear_system import standing_ankles
from probmotion.lifting.page import lift_page
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.motion import Motion

__all__ = ["Lift"]

_BLOCK = 1000  # frames
_AROUND = 0.25  # standard deviation of the kernel over time, seconds
_UNMOVED = 0.04  # weight of a shift of 0, relative to that of an ankle that certainly stands


@dataclass(frozen=True, eq=False)
class Lift:
    """Posterior of a person's motion given the keypoints of V cameras.

    Without a calibration, the world's axes are the image's right, up, and towards the camera, which
    is at (0, ``camera_height``, 0); the floor is y = 0. With one, they are those of the
    calibration, turned to y up: (x, z, -y) of its file.

    Parameters
    ----------
    mean : Motion
        Posterior mean on ``person14``.
    draws : ndarray, (n, L, J, 3)
        Posterior draws, metres.
    cameras : Cameras
        The V cameras, without lens distortion.
    camera_names : tuple of str
        Names of calibrated cameras; empty without a calibration.
    noise : float
        Scale of the keypoints' noise, pixels.
    keypoints : ndarray, (V, L, J, 2)
        Keypoints that were used, undistorted, pixels; 0 where missing.
    weight : ndarray, (V, L, J)
        Multiplier of their precision; 0 where missing.
    swapped : float
        Share of arms and legs whose sides were exchanged before lifting.
    checks : tuple of Check
        Checks of the lift.
    """

    mean: Motion
    draws: np.ndarray
    cameras: Cameras
    camera_names: tuple[str, ...]
    noise: float
    keypoints: np.ndarray
    weight: np.ndarray
    swapped: float
    checks: tuple[Check, ...]

    @cached_property
    def sd(self) -> np.ndarray:
        """Posterior standard deviation of positions relative to the hips, (L, J, 3), metres."""
        deviation = np.empty(self.draws.shape[1:])
        for first in range(0, len(deviation), _BLOCK):  # long recordings have large draws
            rows = slice(first, first + _BLOCK)
            deviation[rows] = from_hips(self.draws[:, rows]).std(axis=0, ddof=1)
        return deviation

    @property
    def on_floor(self) -> Motion:
        """The mean, raised or lowered so that standing feet are on the floor, for animation.

        With one camera, the depth of a person is uncertain by a few percent, and so is the height
        of the feet. The shift is the mean of the heights of ankles above the standing height of 7.5
        cm, weighted by the probabilities that they stand, within about .25 s. With several cameras
        it is 0.
        """
        if self.cameras.n_views > 1:
            return self.mean
        from scipy.ndimage import gaussian_filter1d

        height, standing = standing_ankles(self.mean.positions[:, ANKLES], self.mean.fps)
        total, weight = (
            gaussian_filter1d(values.sum(axis=1), _AROUND * self.mean.fps, mode="nearest")
            for values in (standing * height, standing)
        )
        shift = total / (weight + _UNMOVED)
        positions = self.mean.positions.copy()
        positions[..., 1] -= shift[:, None]
        return replace(self.mean, positions=positions)

    @property
    def camera(self) -> LevelCamera:
        """Focal length, principal point and pitch of the first camera."""
        assert self.cameras.centre is not None
        x, y = self.cameras.centre[0]
        pitch = -float(self.cameras.elevation[0])
        return LevelCamera(float(self.cameras.focal[0]), (float(x), float(y)), pitch)

    @property
    def camera_positions(self) -> np.ndarray:
        """Positions of the cameras, (V, 3), metres."""
        rotation, translation = self.cameras.rotation, self.cameras.translation
        positions: np.ndarray = -np.einsum("vij,vi->vj", rotation, translation)
        return positions

    @property
    def camera_height(self) -> float:
        """Height of the first camera above the floor, or above 0 of a calibration, metres."""
        return float(self.camera_positions[0, 1])

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
        spread = 1000 * np.sqrt((self.sd[:, LIMBS] ** 2).sum(axis=-1))
        precision = (
            f"Joints have a standard deviation of {np.median(spread):.0f} mm relative to the "
            f"hips (largest joint: {spread.mean(axis=0).max():.0f} mm), and keypoints a noise of "
            f"{self.noise:.1f} pixels."
        )
        return [trust, precision, self._filmed()]

    def _filmed(self) -> str:
        """Return the sentence on the cameras."""
        path = self.mean.positions[None, :, 0] - self.camera_positions[:, None]
        if self.camera_names:
            distance = np.linalg.norm(path, axis=-1)
            count = len(self.camera_names)
            return (
                f"Positions are in the world of the calibration, and the person is "
                f"{distance.min():.1f} to {distance.max():.1f} m from the {count} "
                f"camera{'s' if count > 1 else ''} ({', '.join(self.camera_names)})."
            )
        distance = np.linalg.norm(path[..., [0, 2]], axis=-1)
        return (
            f"The camera is {self.camera_height:.2f} m above the floor and looks "
            f"{abs(np.degrees(self.camera.pitch)):.0f}° {'up' if self.camera.pitch > 0 else 'down'}"
            f"; the person is {distance.min():.1f} to {distance.max():.1f} m away."
        )

    def report(self, path: str | Path) -> Path:
        """Write an HTML page with the summary and the motion, and return its path."""
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise ValueError(f"path must end in .html, got {str(path)!r}")
        with written_whole(path) as unfinished:
            seen = np.where(self.weight[..., None] > 0, self.keypoints, np.nan)
            page = lift_page(
                self.mean,
                self.draws,
                self.cameras,
                self.camera_names,
                seen,
                self.checks,
                self.summary(),
            )
            unfinished.write_text(page, encoding="utf-8")
        return path

    def save(self, folder: str | Path) -> None:
        """Write the page, the motion as BVH, GLB and on SMPL's joints, all draws, and a summary.

        The files are ``lift.html``, ``lift.bvh``, ``lift.glb`` (rigid bones), ``lift.npz`` (mean,
        standard deviations and draws), ``lift.smpl22.npz``
        (:func:`~probmotion.io.smpl.smpl_motion`) and ``summary.json``. Files for animation have
        the motion :attr:`on_floor`.
        """
        with written_together(Path(folder)) as unfinished:
            self._write(unfinished)

    def _write(self, folder: Path) -> None:
        """Write the files of :meth:`save`."""
        self.report(folder / "lift.html")
        on_floor = self.on_floor
        rigid = rigid_motion(on_floor)
        save(rigid, folder / "lift.bvh")
        save(rigid, folder / "lift.glb")
        save(smpl_motion(on_floor), folder / "lift.smpl22.npz")
        write_npz(self.mean, folder / "lift.npz", {"sd": self.sd, "draws": self.draws})
        content = {
            "trusted": self.trusted,
            "summary": self.summary(),
            "checks": {
                check.name: {"value": check.value, "limit": check.limit, "passed": check.passed}
                for check in self.checks
            },
            "cameras": [
                {
                    "name": name,
                    "focal": focal,
                    "centre": centre,
                    "pitch_degrees": -float(np.degrees(elevation)),
                    "position": position,
                }
                for name, focal, centre, elevation, position in zip(
                    self.camera_names or ("",),
                    self.cameras.focal.tolist(),
                    np.asarray(self.cameras.centre).tolist(),
                    self.cameras.elevation,
                    self.camera_positions.tolist(),
                    strict=True,
                )
            ],
            "noise_pixels": self.noise,
            "swapped_share": self.swapped,
        }
        (folder / "summary.json").write_text(json.dumps(content, indent=1), encoding="utf-8")

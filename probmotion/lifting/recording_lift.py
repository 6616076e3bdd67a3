"""Lifting of the keypoints of one or several still cameras to 3D motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.io.keypoints.calibration import Calibration, read_calibration
from probmotion.lifting.calibrated import (
    CalibratedView,
    LiftedViews,
    calibrated_views,
    check_size,
    lift_views,
)
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import PERSON, PersonKeypoints, person_keypoints
from probmotion.lifting.result import Lift
from probmotion.lifting.track_lift import TrackLift, lift_track
from probmotion.models.mixture.conditioning import rotation
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.validation import check_count, check_positive

__all__ = ["lift"]

_SLOWEST = 5.0  # frame rate
_FOV = 60.0  # median field of view along the longer side, degrees
_FOCAL_ERROR = 0.3  # of the logarithm of the focal length: 90 % of fields of view are 39° to 87°
_HEIGHT, _HEIGHT_SPREAD = 1.7, 0.06  # of adults: mean, metres, and relative standard deviation
_MEASURED = 0.01  # relative standard deviation of a given height
_LEVEL = 0.05  # standard deviation of the floor about 0 of a calibration, metres
_NOISE = 0.004  # first estimate of the keypoints' noise, of the image's longer side


def lift(
    track: KeypointTrack | Sequence[KeypointTrack],
    *,
    image_size: tuple[int, int] | None = None,
    camera: Calibration | str | Path | None = None,
    fov: float | None = None,
    pitch: float | None = None,
    height: float | None = None,
    noise: float | None = None,
    draws: int = 100,
    seed: int = 0,
    progress: bool = True,
) -> Lift:
    """Return the posterior of a person's 3D motion given the keypoints of still cameras.

    The recording is cut into windows of two seconds that overlap by half. Each has a mixture of
    Gaussian approximations (:mod:`probmotion.lifting.window_fit`) under the prior
    ``cmu-motion``. Means are averaged with weights that fall linearly to 0 at a window's ends; each
    draw continues from the previous window's. The depths of joints and the pitch of an uncalibrated
    camera are estimated by ``pose-depth`` (:mod:`probmotion.models.unseen_depth.pose_depth`), the
    noise of the keypoints, and the floor's height with one camera, in three windows. Their floors
    are level: where the person's distance changes, they correct the pitch, and the focal length of
    a camera that looks up or down. Feet that stand on the floor are held
    (:mod:`probmotion.lifting.linear_system`).

    Draws of an uncalibrated camera have pitches, focal lengths and sizes of their own, drawn
    independently of the path: the paths are approximate, and cameras differ in height.

    Parameters
    ----------
    track : KeypointTrack or sequence of KeypointTrack
        Keypoints of one person, pixels; with ``camera``, a track of every synchronised video, named
        after its camera or in the order of the cameras.
    image_size : tuple of int, optional
        Width and height of the video, pixels; that of the calibration with ``camera``, otherwise
        required.
    camera : Calibration, str or Path, optional
        Calibrated cameras, or their file; see
        :func:`~probmotion.io.keypoints.calibration.read_calibration`. The
        motion is in their world, with y up. With one track, the floor is near y = 0.
    fov : float, optional
        Horizontal field of view, degrees. Distances from the camera are proportional to the focal
        length, which one still view hardly determines: by default, it is 60° along the image's
        longer side (90 % interval: 39° to 87°) if the floor does not tell more, and each draw has
        its own.
    pitch : float, optional
        Angle of the camera above the horizon, degrees, negative if it looks down; estimated by
        default.
    height : float, optional
        The person's height, metres. By default, it is 1.7 ± .1, and each draw has its own; several
        calibrated cameras determine it.
    noise : float, optional
        Scale of the noise of a keypoint of confidence 1, pixels; estimated by default.
    draws : int
        Number of posterior draws.
    seed : int
        Seed of the draws.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If a track is too short or has too few keypoints, tracks and cameras do not match, or
        arguments are out of range.
    MotionFileError
        If the file of the calibration is damaged.
    """
    tracks = [track] if isinstance(track, KeypointTrack) else list(track)
    check_count("draws", draws, least=2)
    check_count("seed", seed, least=0)
    if not tracks:
        raise ValueError("track must be a track or one of every camera, got none")
    for each in tracks:
        if each.fps < _SLOWEST:
            raise ValueError(
                f"track must have at least {_SLOWEST:g} frames per second, got {each.fps:g}; check "
                "fps"
            )
    if height is not None and not 0.5 <= height <= 2.5:
        raise ValueError(f"height must be .5 to 2.5 metres, got {height:g}; is it in metres?")
    if noise is not None:
        check_positive("noise", noise)
    settings = _Settings(height, noise, draws, seed, progress)
    if camera is not None:
        for name, given in (("fov", fov), ("pitch", pitch)):
            if given is not None:
                raise ValueError(f"{name} must not be given with camera, got {given:g}")
        if not isinstance(camera, Calibration):
            camera = read_calibration(camera)
        return _in_calibration(tracks, camera, image_size, settings)
    if len(tracks) > 1:
        raise ValueError(f"camera must be given for several tracks, got {len(tracks)} tracks")
    if image_size is None:
        raise ValueError("image_size must be given without camera, got None")
    return _before_camera(tracks[0], image_size, fov, pitch, settings)


class _Settings(NamedTuple):
    """Settings with and without a calibration; see :func:`lift`."""

    height: float | None
    noise: float | None
    draws: int
    seed: int
    progress: bool

    @property
    def size(self) -> tuple[float, float]:
        """The person's size relative to the prior's, and its relative standard deviation."""
        if self.height is None:
            return 1.0, _HEIGHT_SPREAD
        return self.height / _HEIGHT, _MEASURED

    def lift(
        self,
        keypoints: PersonKeypoints,
        fps: float,
        camera: LevelCamera,
        pitch: float | None,
        focal_error: float,
        guess: float,
    ) -> TrackLift:
        """Return the lift of one camera's keypoints."""
        return lift_track(
            keypoints,
            fps,
            camera,
            pitch,
            focal_error,
            self.noise,
            guess,
            draws=self.draws,
            seed=self.seed,
            progress=self.progress,
        )


def _before_camera(
    track: KeypointTrack,
    image_size: tuple[int, int],
    fov: float | None,
    pitch: float | None,
    settings: _Settings,
) -> Lift:
    """Return the lift before a camera of unknown position."""
    check_positive("image_size", min(image_size))
    if fov is not None and not 10 <= fov <= 150:
        raise ValueError(f"fov must be 10 to 150 degrees, got {fov:g}")
    if pitch is not None and not -80 <= pitch <= 80:
        raise ValueError(f"pitch must be -80 to 80 degrees, got {pitch:g}")
    keypoints = person_keypoints(track)
    _check_visible(keypoints.weight, track)
    _check_inside(keypoints, image_size)
    side = max(image_size) if fov is None else image_size[0]
    focal = 0.5 * side / np.tan(np.radians(fov or _FOV) / 2)
    camera = LevelCamera(focal, (image_size[0] / 2, image_size[1] / 2))
    known = None if pitch is None else float(np.radians(pitch))
    error = _FOCAL_ERROR if fov is None else 0.0
    seen = settings.lift(keypoints, track.fps, camera, known, error, _NOISE * max(image_size))
    draws = seen.draws  # large: changed in place
    if fov is None:
        # The image of a body is nearly the same at r times the distance for r times the focal
        # length. Keypoints hardly tell them apart.
        rng = seeds.generator(settings.seed, "lift: focal length")
        ratio = np.exp(seen.focal_error * rng.standard_normal((settings.draws, 1, 1)))
        draws[..., 2] += (ratio - 1) * draws[:, :, :1, 2]
    scale, spread = settings.size
    # Size, distance and the camera's height are proportional.
    draws[..., 1] -= seen.floor
    draws *= scale
    draws *= _sizes(spread, settings)
    mean = scale * (seen.mean - [0.0, seen.floor, 0.0])
    placed = replace(seen.camera, position=(0.0, -scale * seen.floor, 0.0))
    return Lift(
        Motion(mean, PERSON, track.fps, name=track.name),
        draws,
        placed.pinhole(),
        (),
        seen.noise,
        keypoints.points[None],
        keypoints.weight[None],
        keypoints.swapped,
        seen.checks,
    )


def _in_calibration(
    tracks: Sequence[KeypointTrack],
    calibration: Calibration,
    image_size: tuple[int, int] | None,
    settings: _Settings,
) -> Lift:
    """Return the lift in the world of calibrated cameras."""
    found, views = calibrated_views(tracks, calibration)
    sizes = [calibration.sizes[index] for index in found]
    for view, size in zip(views, sizes, strict=True):
        if image_size is not None and tuple(image_size) != size:
            raise ValueError(
                f"image_size must be that of the calibration, {size[0]} × {size[1]} of "
                f"{view.name}, got {image_size[0]} × {image_size[1]}"
            )
    first, guess = tracks[0], _NOISE * max(map(max, sizes))
    if len(views) == 1:
        _check_visible(views[0].keypoints.weight, first)
        result = _placed(views[0], first.fps, guess, settings)
    else:
        result = lift_views(
            views,
            first.fps,
            size=None if settings.height is None else settings.size[0],
            noise=settings.noise,
            guess=guess,
            draws=settings.draws,
            seed=settings.seed,
            progress=settings.progress,
        )
    return Lift(
        # Tracks of several views are named after their cameras.
        Motion(result.mean, PERSON, first.fps, name=first.name if len(views) == 1 else ""),
        result.draws,
        calibration.cameras.views(found),
        tuple(view.name for view in views),
        result.noise,
        np.stack([view.pixels(used) for view, used in zip(views, result.keypoints, strict=True)]),
        np.stack([used.weight for used in result.keypoints]),
        float(np.mean([used.swapped for used in result.keypoints])),
        result.checks,
    )


def _placed(view: CalibratedView, fps: float, guess: float, settings: _Settings) -> LiftedViews:
    """Return the posterior given one calibrated camera above a known floor."""
    camera = LevelCamera(view.camera.focal, view.camera.centre)
    seen = settings.lift(view.keypoints, fps, camera, view.camera.pitch, 0.0, guess)
    scale, spread = settings.size
    # The height of the camera in units of the body's size tells the size.
    height = view.camera.position[1]
    precisions = np.array([spread**-2, (seen.floor * scale / _LEVEL) ** 2])
    ratio = float(precisions @ [1.0, -height / (seen.floor * scale)] / precisions.sum())
    scale, spread = scale * ratio, float(precisions.sum() ** -0.5)
    check_size(scale)
    turn = rotation(view.camera.heading).T
    mean = scale * seen.mean @ turn + view.camera.position
    for draw, size in zip(seen.draws, _sizes(spread, settings), strict=True):
        draw[:] = scale * (draw * size) @ turn + view.camera.position
    return LiftedViews(mean, seen.draws, seen.noise, [view.keypoints], seen.checks)


def _sizes(spread: float, settings: _Settings) -> np.ndarray:
    """Return the relative size of each draw, (n, 1, 1, 1)."""
    rng = seeds.generator(settings.seed, "lift: size")
    return 1 + spread * rng.standard_normal((settings.draws, 1, 1, 1))


def _check_visible(weight: np.ndarray, track: KeypointTrack) -> None:
    """Refuse recordings in which the person is absent from half of the frames."""
    limbs = (weight > 0).sum(axis=1) >= 6
    if limbs.mean() < 0.5:
        raise ValueError(
            f"track must show the person in at least half of the frames, got "
            f"{int(limbs.sum())} of {track.frames} frames with six limb joints; cut the video"
        )


def _check_inside(keypoints: PersonKeypoints, image_size: tuple[int, int]) -> None:
    """Refuse keypoints that are not pixels of the image."""
    seen = keypoints.points[keypoints.weight > 0]
    low, high = np.quantile(seen, 0.05, axis=0), np.quantile(seen, 0.95, axis=0)
    size = np.array(image_size)
    if (high > 1.1 * size).any() or (low < -0.1 * size).any() or (high - low).max() < 5:
        raise ValueError(
            f"keypoints must be pixels of an image of {image_size[0]} × {image_size[1]}, got "
            f"{low[0]:.3g} to {high[0]:.3g} in x and {low[1]:.3g} to {high[1]:.3g} in y; give "
            "the video's size (--image-size) and keypoints in pixels"
        )

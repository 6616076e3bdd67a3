"""2D annotations from keypoint tracks of several people in a video.

If a track has all joints of ``person17`` by canonical name, they are used directly. Otherwise the
limbs are used and the other joints are interpolated:

- pelvis, spine, chest and neck on the line from mid-hips to mid-shoulders, at the same
  fraction as the projection of the seed's joint onto the seed's line;
- head at the midpoint of the ears, else midway from the neck to the top of the head, else the nose.

An interpolated joint is occluded if any of the keypoints it is computed from is occluded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probmotion.data.pair_sets import check_close_people
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = [
    "annotations_of_keypoints",
    "annotations_of_tracks",
    "keypoints_of_tracks",
    "running_median",
]

_TRUNK = ("pelvis", "spine", "chest", "neck")
_FULL_LENGTH = 0.9  # quantile of a bone's projected length used as its 3D length
_STEADY = 0.12  # half the length of running medians and means of bones, seconds


def annotations_of_tracks(
    tracks: Sequence[KeypointTrack],
    seed: np.ndarray,
    *,
    metres_per_pixel: float | None = None,
    least_confidence: float = 0.3,
) -> Annotations:
    """Return annotations of ``pair17`` for the frames of a video in which every person is visible.

    Parameters
    ----------
    tracks, seed, metres_per_pixel, least_confidence
        As for :func:`keypoints_of_tracks`.

    Returns
    -------
    annotations : Annotations
        Annotations; ``dropped`` counts the frames in which a person has no visible joint.
    """
    keypoints = keypoints_of_tracks(
        tracks, seed, metres_per_pixel=metres_per_pixel, least_confidence=least_confidence
    )
    return annotations_of_keypoints(keypoints, tracks[0].fps, tracks[0].name)


def keypoints_of_tracks(
    tracks: Sequence[KeypointTrack],
    seed: np.ndarray,
    *,
    metres_per_pixel: float | None = None,
    least_confidence: float = 0.3,
) -> np.ndarray:
    """Return the keypoints of ``pair17`` in every frame, (L, J, 2), metres, y up.

    Joints that are not visible are NaN.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        One track per person, in the order of the seed, over the same frames.
    seed : ndarray, (J, 3)
        Pose-pair of ``pair17``, metres; defines bone lengths and the positions of trunk joints.
    metres_per_pixel : float, optional
        Scale of the image. Default: the median over limb bones of the bone's length in the seed
        divided by the 90 % quantile of its length in the image, steadied over time.
    least_confidence : float
        Minimum confidence; keypoints below it count as occluded.

    Raises
    ------
    ValueError
        If tracks are not two of equal length and rate, lack limb keypoints, or never show both
        people in one frame.
    """
    skeleton, person = Skeleton.preset("pair17"), Skeleton.preset("person17")
    seed = np.asarray(seed, dtype=np.float64)
    check_close_people("seed", seed, skeleton)
    if len(tracks) != len(skeleton.roots):
        raise ValueError(f"tracks must contain 2 tracks, one per person, got {len(tracks)}")
    for number, track in enumerate(tracks):
        if (track.frames, track.fps) != (tracks[0].frames, tracks[0].fps):
            raise ValueError(
                f"tracks[{number}] must have {tracks[0].frames} frames at {tracks[0].fps:g} frames "
                f"per second, like tracks[0], got {track.frames} at {track.fps:g}"
            )
    check_positive("least_confidence", least_confidence)
    keypoints = np.concatenate(
        [
            _person_joints(track, seed[root : root + person.n_joints], person, least_confidence)
            for track, root in zip(tracks, skeleton.roots, strict=True)
        ],
        axis=1,
    )
    keypoints *= [1.0, -1.0]  # y up
    if not _shows_all(keypoints).any():
        raise ValueError(
            f"tracks must have a frame in which all {len(tracks)} people are visible with a "
            f"confidence of at least {least_confidence:g}, got none"
        )
    if metres_per_pixel is None:
        metres_per_pixel = _scale(keypoints, seed, skeleton, tracks[0].fps)
    check_positive("metres_per_pixel", metres_per_pixel)
    return keypoints * metres_per_pixel


def annotations_of_keypoints(keypoints: np.ndarray, fps: float, name: str = "") -> Annotations:
    """Return the annotations of a video from keypoints (L, J, 2) of :func:`keypoints_of_tracks`.

    ``name`` is the video's; ``dropped`` counts the frames in which a person has no visible joint.
    """
    complete = _shows_all(keypoints)
    padded = np.pad(keypoints, ((1, 1), (0, 0), (0, 0)), constant_values=np.nan)
    return Annotations(
        keypoints[complete],
        np.isfinite(keypoints).all(axis=-1)[complete],
        Skeleton.preset("pair17"),
        np.stack([padded[:-2], padded[2:]], axis=1)[complete],
        fps,
        sources=[name] * int(complete.sum()),
        dropped={"one person missing": int((~complete).sum())},
    )


def running_median(values: np.ndarray, half: int) -> np.ndarray:
    """Return medians over 2 ``half`` + 1 frames (axis 0), the lower one of two; NaN is ignored."""
    ends = ((half, half), *((0, 0) for _ in values.shape[1:]))
    padded = np.pad(values, ends, constant_values=np.nan)
    windows = np.sort([padded[s : s + len(values)] for s in range(2 * half + 1)], axis=0)
    middle = np.maximum((~np.isnan(windows)).sum(axis=0) - 1, 0) // 2
    median: np.ndarray = np.take_along_axis(windows, middle[None], axis=0)[0]
    return median


def _shows_all(keypoints: np.ndarray) -> np.ndarray:
    """Return a mask (L,) of the frames in which every person has a visible joint."""
    people = len(Skeleton.preset("pair17").roots)
    visible = np.isfinite(keypoints).all(axis=-1).reshape(len(keypoints), people, -1)
    shown: np.ndarray = visible.any(axis=-1).all(axis=-1)
    return shown


def _person_joints(
    track: KeypointTrack, seed: np.ndarray, person: Skeleton, least_confidence: float
) -> np.ndarray:
    """Return one person's joints in pixels, NaN if occluded: ``(L, 17, 2)``."""
    confident = track.confidence >= least_confidence
    points = np.where(confident[..., np.newaxis], track.keypoints, np.nan)
    names = [name.rpartition(":")[2] for name in track.skeleton.canonical_names]
    joints = {name: points[:, joint] for joint, name in enumerate(names)}
    if not set(person.joint_names) <= set(joints):
        limbs = [name for name in person.joint_names if name.startswith(("left", "right"))]
        missing = [name for name in limbs if name not in joints]
        if missing:
            raise ValueError(
                f"tracks must have all limb keypoints, got {track.name or 'a track'} without "
                f"{', '.join(missing)}"
            )
        joints["head"] = _head(joints)
        joints |= _trunk(joints, seed, person)
    return np.stack([joints[name] for name in person.joint_names], axis=1)


def _trunk(
    joints: dict[str, np.ndarray], seed: np.ndarray, person: Skeleton
) -> dict[str, np.ndarray]:
    """Return pelvis, spine, chest and neck on the line from mid-hips to mid-shoulders."""
    reference = dict(zip(person.joint_names, seed, strict=True))
    (low, high), (seed_low, seed_high) = (
        [(pose[f"left_{part}"] + pose[f"right_{part}"]) / 2 for part in ("hip", "shoulder")]
        for pose in (joints, reference)
    )
    line = seed_high - seed_low
    fractions = {name: (reference[name] - seed_low) @ line / (line @ line) for name in _TRUNK}
    return {name: low + fraction * (high - low) for name, fraction in fractions.items()}


def _head(joints: dict[str, np.ndarray]) -> np.ndarray:
    """Return the head in each frame: from the ears, else neck and top of the head, else nose."""
    missing = np.full_like(joints["left_hip"], np.nan)
    neck = joints.get("upper_neck", joints.get("neck", missing))
    sources = [
        (joints.get("left_ear", missing) + joints.get("right_ear", missing)) / 2,
        (neck + joints.get("head_top", missing)) / 2,
        joints.get("nose", missing),
    ]
    head = missing
    for source in sources:
        head = np.where(np.isnan(head), source, head)
    return head


def _scale(keypoints: np.ndarray, seed: np.ndarray, skeleton: Skeleton, fps: float) -> float:
    """Return metres per pixel from the limbs' projected lengths.

    Noise lengthens bones: they are first steadied by a running median and a running mean.
    """
    parts = ("elbow", "wrist", "knee", "ankle")
    half = round(_STEADY * fps)
    ratios = []
    for joint, parent in skeleton.bones:
        if not skeleton.joint_names[joint].endswith(parts):
            continue
        bones = running_median(keypoints[:, joint] - keypoints[:, parent], half)
        lengths = np.linalg.norm(_running_mean(bones, half), axis=-1)
        lengths = lengths[np.isfinite(lengths)]
        longest = np.quantile(lengths, _FULL_LENGTH) if len(lengths) else 0.0
        if longest > 0:
            ratios.append(float(np.linalg.norm(seed[joint] - seed[parent]) / longest))
    if not ratios:
        raise ValueError(
            "tracks must show both ends of a forearm, upper arm, thigh or shin in some frame, got "
            "none: the scale is unknown; use keypoints that show limbs (annotations_of_tracks "
            "takes metres_per_pixel instead)"
        )
    return float(np.median(ratios))


def _running_mean(values: np.ndarray, half: int) -> np.ndarray:
    """Return means over 2 ``half`` + 1 frames (axis 0), of fewer at the ends; NaN stays NaN."""
    known = np.isfinite(values)
    total = np.pad(np.cumsum(np.where(known, values, 0.0), axis=0), ((1, 0), (0, 0)))
    count = np.pad(np.cumsum(known, axis=0), ((1, 0), (0, 0)))
    frames = np.arange(len(values))
    first, last = np.maximum(frames - half, 0), np.minimum(frames + half + 1, len(values))
    means = (total[last] - total[first]) / np.maximum(count[last] - count[first], 1)
    return np.where(known, means, np.nan)

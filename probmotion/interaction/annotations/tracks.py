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

__all__ = ["annotations_of_tracks"]

_TRUNK = ("pelvis", "spine", "chest", "neck")
_FULL_LENGTH = 0.95  # quantile of a bone's projected length used as its 3D length


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
    tracks : sequence of KeypointTrack
        One track per person, in the order of the seed, over the same frames.
    seed : ndarray, (J, 3)
        Pose-pair of ``pair17``, metres; defines bone lengths and the positions of trunk joints.
    metres_per_pixel : float, optional
        Scale of the image. Default: the median over limb bones of the bone's length in the seed
        divided by the 95 % quantile of its length in the image.
    least_confidence : float
        Minimum confidence; keypoints below it count as occluded.

    Returns
    -------
    annotations : Annotations
        Annotations; ``dropped`` counts the frames in which a person has no visible joint.
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
    visible = np.isfinite(keypoints).all(axis=-1)
    complete = visible.reshape(len(visible), len(tracks), -1).any(axis=-1).all(axis=-1)
    if not complete.any():
        raise ValueError(
            f"tracks must have a frame in which all {len(tracks)} people are visible, got none"
        )
    if metres_per_pixel is None:
        metres_per_pixel = _scale(keypoints, seed, skeleton)
    check_positive("metres_per_pixel", metres_per_pixel)
    keypoints *= metres_per_pixel
    padded = np.pad(keypoints, ((1, 1), (0, 0), (0, 0)), constant_values=np.nan)
    return Annotations(
        keypoints[complete],
        visible[complete],
        skeleton,
        np.stack([padded[:-2], padded[2:]], axis=1)[complete],
        tracks[0].fps,
        sources=[tracks[0].name] * int(complete.sum()),
        dropped={"one person missing": int((~complete).sum())},
    )


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


def _scale(keypoints: np.ndarray, seed: np.ndarray, skeleton: Skeleton) -> float:
    """Return metres per pixel from the limbs' projected lengths."""
    parts = ("elbow", "wrist", "knee", "ankle")
    ratios = []
    for joint, parent in skeleton.bones:
        if not skeleton.joint_names[joint].endswith(parts):
            continue
        lengths = np.linalg.norm(keypoints[:, joint] - keypoints[:, parent], axis=-1)
        lengths = lengths[np.isfinite(lengths)]
        longest = np.quantile(lengths, _FULL_LENGTH) if len(lengths) else 0.0
        if longest > 0:
            ratios.append(float(np.linalg.norm(seed[joint] - seed[parent]) / longest))
    if not ratios:
        raise ValueError("tracks must have a visible limb bone, got none: pass metres_per_pixel")
    return float(np.median(ratios))

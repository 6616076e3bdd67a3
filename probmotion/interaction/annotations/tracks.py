"""Annotations from the keypoint tracks that detectors find in a video of several people.

Detectors lack some joints of motion capture. Where a track has every joint of the person by its
canonical name, they are taken as they are. Otherwise shoulders, elbows, wrists, hips, knees and
ankles are taken, and the rest is put where the seed has it:

- pelvis, spine, chest and neck on the line from the middle of the hips to the middle of the
  shoulders, at the share of it where the seed's joint projects onto the seed's line;
- head in the middle of the ears; else half way from a detected neck to the top of the head; else
  at the nose.

A joint made of several keypoints is hidden where one of them is.
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
_FULL_LENGTH = 0.95  # the quantile of a bone's projected length that is taken for its whole


def annotations_of_tracks(
    tracks: Sequence[KeypointTrack],
    seed: np.ndarray,
    *,
    metres_per_pixel: float | None = None,
    least_confidence: float = 0.3,
) -> Annotations:
    """Return the frames of one video in which every character is seen, as ``pair17`` has them.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        One track per character, in the seed's order, of the same frames.
    seed : ndarray, (J, 3)
        A pose-pair of ``pair17``, metres: its bone lengths and the places of its trunk's joints.
    metres_per_pixel : float, optional
        By default the median over all limb bones of the seed's length divided by the 95 % quantile
        of the length in the pictures: over enough frames each bone lies in the image plane once.
    least_confidence : float
        A keypoint of less confidence is hidden.

    Returns
    -------
    annotations : Annotations
        ``dropped`` counts the frames in which a character shows no joint.

    Raises
    ------
    ValueError
        If a track is missing, tracks differ in length or rate, a track has not the keypoints, no
        frame shows all characters, or no limb is seen to take the scale from.
    """
    skeleton = Skeleton.preset("pair17")
    seed = np.asarray(seed, dtype=np.float64)
    check_close_people("seed", seed, skeleton)
    _check_tracks(tracks, len(skeleton.roots))
    check_positive("least_confidence", least_confidence)
    person = Skeleton.preset("person17")
    pictures = np.concatenate(
        [
            _person_joints(track, seed[root : root + person.n_joints], person, least_confidence)
            for track, root in zip(tracks, skeleton.roots, strict=True)
        ],
        axis=1,
    )
    pictures *= [1.0, -1.0]  # y up
    visible = np.isfinite(pictures).all(axis=-1)
    seen = np.stack([part.any(axis=-1) for part in np.split(visible, len(tracks), axis=1)])
    kept = np.flatnonzero(seen.all(axis=0))
    if len(kept) == 0:
        raise ValueError(
            f"tracks has no frame that shows all {len(tracks)} persons, expected at least one"
        )
    if metres_per_pixel is None:
        metres_per_pixel = _scale(pictures, seed, skeleton)
    check_positive("metres_per_pixel", metres_per_pixel)
    pictures *= metres_per_pixel
    gap = np.full((1, *pictures.shape[1:]), np.nan)
    before = np.concatenate([gap, pictures[:-1]])
    after = np.concatenate([pictures[1:], gap])
    return Annotations(
        pictures[kept],
        visible[kept],
        skeleton,
        np.stack([before, after], axis=1)[kept],
        tracks[0].fps,
        sources=[tracks[0].name] * len(kept),
        dropped={"one person missing": len(pictures) - len(kept)},
    )


def _check_tracks(tracks: Sequence[KeypointTrack], count: int) -> None:
    if len(tracks) != count:
        missing = " (one person missing)" if len(tracks) < count else ""
        raise ValueError(f"tracks has {len(tracks)} tracks{missing}, expected {count}")
    first = tracks[0]
    for number, track in enumerate(tracks):
        if track.frames != first.frames:
            raise ValueError(
                f"tracks[{number}] has {track.frames} frames and the first {first.frames}, "
                "expected the same frames of one video"
            )
        if track.fps != first.fps:
            raise ValueError(
                f"tracks[{number}] has {track.fps:g} frames per second and the first "
                f"{first.fps:g}, expected one video"
            )


def _person_joints(
    track: KeypointTrack, seed: np.ndarray, person: Skeleton, least_confidence: float
) -> np.ndarray:
    """Return one person's joints in pixels, NaN where hidden: ``(L, 17, 2)``."""
    sure = track.confidence >= least_confidence
    points = np.where(sure[..., np.newaxis], track.keypoints, np.nan)
    names = [name.rpartition(":")[2] for name in track.skeleton.canonical_names]
    found = {name: points[:, joint] for joint, name in enumerate(names)}
    if not set(person.joint_names) <= set(found):
        limbs = [name for name in person.joint_names if name.startswith(("left", "right"))]
        lacking = [name for name in limbs if name not in found]
        if lacking:
            raise ValueError(
                f"tracks has {track.name or 'a track'} without {', '.join(lacking)}, expected the "
                "keypoints of a body"
            )
        found["head"] = _head(found)
        found |= _trunk(found, seed, person)
    return np.stack([found[name] for name in person.joint_names], axis=1)


def _trunk(
    found: dict[str, np.ndarray], seed: np.ndarray, person: Skeleton
) -> dict[str, np.ndarray]:
    """Return pelvis, spine, chest and neck on the line from mid hips to mid shoulders."""
    low, high = (
        (found[f"left_{part}"] + found[f"right_{part}"]) / 2 for part in ("hip", "shoulder")
    )
    seed_low, seed_high = (
        (seed[person.index(f"left_{part}")] + seed[person.index(f"right_{part}")]) / 2
        for part in ("hip", "shoulder")
    )
    line = seed_high - seed_low
    shares = {
        name: float((seed[person.index(name)] - seed_low) @ line / (line @ line)) for name in _TRUNK
    }
    return {name: low + share * (high - low) for name, share in shares.items()}


def _head(found: dict[str, np.ndarray]) -> np.ndarray:
    """Return the head, from the first of its sources that is seen in a frame."""
    hidden = np.full_like(found["left_hip"], np.nan)
    neck = found.get("upper_neck", found.get("neck", hidden))
    sources = [
        (found.get("left_ear", hidden) + found.get("right_ear", hidden)) / 2,
        (neck + found.get("head_top", hidden)) / 2,
        found.get("nose", hidden),
    ]
    head = hidden
    for source in sources:
        head = np.where(np.isnan(head), source, head)
    return head


def _scale(pictures: np.ndarray, seed: np.ndarray, skeleton: Skeleton) -> float:
    """Return metres per pixel from the limbs' projected lengths."""
    parts = ("elbow", "wrist", "knee", "ankle")
    ratios = []
    for joint, parent in skeleton.bones:
        if not skeleton.joint_names[joint].endswith(parts):
            continue
        lengths = np.linalg.norm(pictures[:, joint] - pictures[:, parent], axis=-1)
        lengths = lengths[np.isfinite(lengths)]
        longest = np.quantile(lengths, _FULL_LENGTH) if len(lengths) else 0.0
        if longest > 0:
            ratios.append(float(np.linalg.norm(seed[joint] - seed[parent]) / longest))
    if not ratios:
        raise ValueError("tracks has no limb that must be one, or metres_per_pixel, got seen")
    return float(np.median(ratios))

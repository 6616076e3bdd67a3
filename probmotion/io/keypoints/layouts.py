"""Tracks of detections whose keypoints have no names: the layout by the number of keypoints.

The layout is the preset with as many keypoints. Of COCO-WholeBody (133) and Halpe (136), the
keypoints of the body are read. OpenPose's two layouts of 25 keypoints are told apart by the lengths
of their bones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.tracks import (
    Detection,
    KeypointFile,
    Parsed,
    link_people,
    tracks_of,
)
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count

__all__ = ["keypoint_file"]

_BY_COUNT = {16: "alphapose16", 17: "coco17", 18: "openpose18", 26: "halpe26"}  # presets
_BODY = {133: 17, 136: 26}  # keypoints of the body in COCO-WholeBody and Halpe
_TWO_LAYOUTS = {25: " ('body25' or 'body25b')"}  # ambiguous keypoint counts


def keypoint_file(
    parsed: Parsed,
    path: Path,
    fps: float | None = None,
    skeleton: Skeleton | None = None,
    people: int | None = None,
) -> KeypointFile:
    """Return the tracks of detections whose keypoints have no names.

    ``skeleton`` is their layout. The arguments are those of
    :func:`~probmotion.io.files.open_keypoints`, which has the errors.
    """
    detections, given = parsed.detections, skeleton or parsed.skeleton
    counts = sorted({len(detection.values) for detection in detections})
    if len(counts) > 1:
        raise MotionFileError(f"{path}: expected the same number of keypoints, got {counts}")
    if not counts:
        raise MotionFileError(f"{path}: expected at least one person, got none")
    if skeleton is None and counts[0] in _BODY:  # of a layout with hands and a face
        detections = [replace(one, values=one.values[: _BODY[counts[0]]]) for one in detections]
        counts, given = [_BODY[counts[0]]], None
    if people is not None:
        check_count("people", people)
        if not _identified(detections):
            detections = link_people(detections, people)
    rate = parsed.fps if fps is None else fps
    layout = _layout(detections, given, path)
    tracks = tracks_of(detections, parsed.frames, layout, rate, path, parsed.numbered)
    return KeypointFile(parsed.format, rate, tracks, parsed.image_size, parsed.fps)


def _identified(detections: list[Detection]) -> bool:
    """Return whether people have ids, other than one that several people of an image share."""
    ids = {one.person for one in detections}
    images = {(one.video, one.frame) for one in detections}
    return ids != {None} and (len(ids) > 1 or len(images) == len(detections))


def _layout(detections: list[Detection], given: Skeleton | None, path: Path) -> Skeleton:
    """Return the given or the default skeleton of the keypoints."""
    count = len(detections[0].values)
    if given is None:
        if count == 25 and (layout := _layout_of_25(detections)) is not None:
            return Skeleton.preset(layout)
        if count not in _BY_COUNT:
            wanted = f"{count} keypoints{_TWO_LAYOUTS.get(count, '')}"
            known = ", ".join(f"{number} ({name})" for number, name in _BY_COUNT.items())
            raise MotionFileError(
                f"{path}: skeleton must be given for {wanted}, got None (--skeleton; see "
                f"probmotion list); recognised are {known}, 25 (OpenPose), "
                "133 and 136 (bodies of COCO-WholeBody and Halpe)"
            )
        return Skeleton.preset(_BY_COUNT[count])
    if given.n_joints != count:
        raise MotionFileError(
            f"{path}: expected {given.n_joints} keypoints as in skeleton, got {count}"
        )
    return given


def _layout_of_25(detections: list[Detection]) -> str | None:
    """Return OpenPose's layout of 25 keypoints whose bones are at most half as long, or None.

    The median ratio over all detections counts. In six real tracks of BODY_25B, and in the same
    tracks converted to BODY_25, bones of the right layout are shorter by a factor of 2.5 to 6. In
    3000 random orders of the keypoints, the factor is at most 1.8.
    """
    values = np.array([detection.values for detection in detections])
    lengths = []
    for layout in ("body25", "body25b"):
        joint, parent = np.array(Skeleton.preset(layout).bones).T
        seen = (values[:, joint, 2] > 0) & (values[:, parent, 2] > 0)
        bones = np.linalg.norm(values[:, joint, :2] - values[:, parent, :2], axis=-1)
        lengths.append(np.where(seen, bones, 0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
    first, second = (length[np.min(lengths, axis=0) > 0] for length in lengths)
    if not len(first):
        return None
    ratio = np.median(first / second)
    return "body25" if ratio <= 0.5 else "body25b" if ratio >= 2 else None

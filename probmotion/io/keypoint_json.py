"""Reader of keypoint tracks in the JSON formats of COCO, AlphaPose and OpenPose.

=====================  ==========================================================================
format                 content
=====================  ==========================================================================
COCO annotations       ``{"images": […], "annotations": [{"image_id", "keypoints", …}], …}``
COCO results           ``[{"image_id": "12.jpg", "keypoints": [x, y, confidence, …]}, …]``
AlphaPose              as COCO results, with the track id in ``"idx"``
AlphaPose "open",      ``{"12.jpg": {"people": [{"pose_keypoints_2d": […]}]}, …}``,
AlphaPose "cmu"        ``{"12.jpg": {"bodies": [{"joints": […]}]}, …}``
OpenPose               a folder of files ``{"people": [{"pose_keypoints_2d": […]}]}``, one per
                       frame; one such file; or a list of frames in one file
=====================  ==========================================================================

In COCO annotations and OpenPose files, the listed images are the frames. The other formats list
only images with a detection: the frame is the last number in the image's name, and tracks include
all frames from the first to the last. Keypoints of confidence 0 are NaN. The visibility v of COCO
annotations becomes the confidence v/2: 0 not labelled, 0.5 occluded, 1 visible.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import MotionFileError, read_bytes, shortened
from probmotion.io.keypoint_linking import link_people
from probmotion.io.keypoint_tracks import (
    Detection,
    Frames,
    frame_number,
    keypoint_values,
    natural,
    tracks_of,
)
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["read_keypoint_json"]

_BY_COUNT = {16: "alphapose16", 17: "coco17", 18: "openpose18", 26: "halpe26"}  # presets
_TWO_LAYOUTS = {25: " ('body25' or 'body25b')"}  # ambiguous keypoint counts


def read_keypoint_json(
    path: str | Path,
    fps: float,
    skeleton: Skeleton | str | None = None,
    people: int | None = None,
) -> list[KeypointTrack]:
    """Read the keypoint track of every person.

    Parameters
    ----------
    path : str or Path
        JSON file, or folder of OpenPose files, one per frame.
    fps : float
        Frames per second, which these files do not contain.
    skeleton : Skeleton or str, optional
        The detector's keypoints in its order, or the name of a preset. Default: the keypoints of
        the COCO ``categories``, or else the preset with as many keypoints (16 AlphaPose, 17 COCO,
        18 OpenPose, 26 Halpe); 25 keypoints are ambiguous.
    people : int, optional
        Number of people to track between images in a file without track ids; see
        :func:`~probmotion.io.keypoint_linking.link_people`.

    Returns
    -------
    tracks : list of KeypointTrack
        One per person and video. People are identified by ``track_id``, ``idx`` or ``person_id``;
        otherwise frames must contain one person, unless ``people`` is given.

    Raises
    ------
    MotionFileError
        If the file contains no keypoint tracks or is damaged.
    ValueError
        If ``fps`` is not above 0, ``skeleton`` is an unknown name, or ``people`` exceeds
        the largest number of people in an image.
    """
    path = Path(path)
    check_positive("fps", fps)
    given = Skeleton.preset(skeleton) if isinstance(skeleton, str) else skeleton
    frames: Frames | None = None
    content = None if path.is_dir() else _load(path)
    if path.is_dir():
        detections, frames = _folder(path)
    elif isinstance(content, dict) and "annotations" in content:
        detections, frames = _annotations(content, path)
        given = given or _category_skeleton(content, path)
    elif isinstance(content, dict) and "people" in content:
        detections, frames = _people(content, "", 0, f"{path}"), {"": range(1)}
    elif isinstance(content, list) and _all_have(content, "people"):
        detections, frames = [], {"": range(len(content))}
        for index, frame in enumerate(content):
            detections += _people(frame, "", index, f"{path}, frame {index}")
    elif isinstance(content, list) and _all_have(content, "keypoints"):
        detections = _results(content, path)
    elif isinstance(content, dict) and (
        _all_have(content.values(), "people") or _all_have(content.values(), "bodies")
    ):
        detections = []
        for image, frame in content.items():
            video, index = frame_number(image, f"{path}, image")
            detections += _people(frame, video, index, f"{path}, {shortened(image)}")
    else:
        raise MotionFileError(
            f"{path}: expected keypoints of COCO (annotations, or a list with image_id and "
            f"keypoints), AlphaPose or OpenPose (people), got {_described(content)}"
        )
    counts = sorted({len(detection.values) for detection in detections})
    if len(counts) > 1:
        raise MotionFileError(f"{path}: expected the same number of keypoints, got {counts}")
    if people is not None:
        check_count("people", people)
        if all(detection.person is None for detection in detections):
            detections = link_people(detections, people)
    return tracks_of(detections, frames, _checked_skeleton(given, counts, path), float(fps), path)


def _annotations(content: dict[str, Any], path: Path) -> tuple[list[Detection], Frames]:
    """Return the detections of COCO annotations and the frames of each video."""
    where = f"{path}, images"
    images = _dicts(content.get("images"), where)
    order = next(
        (key for key in ("frame_id", "file_name", "id") if all(key in image for image in images)),
        "id",
    )
    images = sorted(images, key=lambda image: natural(_identity(image, (order,), where) or ""))
    locations: dict[Any, tuple[str, int]] = {}
    length: dict[str, int] = {}
    for image in images:
        video = _identity(image, ("video_id", "vid_id"), where) or ""
        image_id = _identity(image, ("id",), where)
        if image_id is None or image_id in locations:
            raise MotionFileError(f"{where}: expected unique ids, got {shortened(image_id)}")
        length[video] = length.get(video, 0) + 1
        locations[image_id] = video, length[video] - 1

    detections = []
    for number, person in enumerate(_dicts(content["annotations"], f"{path}, annotations")):
        where = f"{path}, annotations[{number}]"
        image_id = _identity(person, ("image_id",), where)
        if image_id not in locations:
            raise MotionFileError(
                f"{where}: image_id must be the id of an image, got {shortened(image_id)}"
            )
        values = keypoint_values(person.get("keypoints"), where)
        if not np.isin(values[:, 2], (0, 1, 2)).all():
            got = shortened(values[:, 2].tolist())
            raise MotionFileError(f"{where}: expected visibilities 0, 1 or 2, got {got}")
        values[:, 2] /= 2
        track_id = _identity(person, ("track_id", "instance_id"), where)
        detections.append(Detection(*locations[image_id], track_id, values, where))
    return detections, {video: range(count) for video, count in length.items()}


def _results(content: list[dict[str, Any]], path: Path) -> list[Detection]:
    """Return the detections of COCO results or AlphaPose's default format."""
    detections = []
    for number, person in enumerate(content):
        where = f"{path}, [{number}]"
        location = frame_number(person.get("image_id"), f"{where}, image_id")
        values = keypoint_values(person["keypoints"], where)
        track_id = _identity(person, ("track_id", "idx"), where)
        detections.append(Detection(*location, track_id, values, where))
    return detections


def _people(frame: dict[str, Any], video: str, number: int, where: str) -> list[Detection]:
    """Return the detections of one frame in the OpenPose or a similar AlphaPose format."""
    key = "people" if "people" in frame else "bodies"
    detections = []
    for index, person in enumerate(_dicts(frame[key], f"{where}, {key}")):
        location = f"{where}, {key}[{index}]"
        names = ("pose_keypoints_2d", "pose_keypoints", "joints")
        keypoints = next((person[name] for name in names if name in person), None)
        if keypoints == []:  # only a face or a hand
            continue
        track_id = _identity(person, ("person_id", "idx", "track_id"), location)
        values = keypoint_values(keypoints, location)
        detections.append(Detection(video, number, track_id, values, location))
    return detections


def _folder(path: Path) -> tuple[list[Detection], Frames]:
    """Return the detections and frames of an OpenPose folder with evenly spaced file numbers."""
    files = sorted(path.glob("*.json"), key=lambda file: natural(file.name))
    if not files:
        raise MotionFileError(f"{path}: expected OpenPose .json files, one per frame, got none")
    detections: list[Detection] = []
    numbers: dict[str, list[int]] = {}
    for file in files:
        content = _load(file)
        if not isinstance(content, dict) or "people" not in content:
            raise MotionFileError(
                f"{file}: expected an OpenPose frame with people, got {_described(content)}"
            )
        video, number = frame_number(file.name, str(file))
        numbers.setdefault(video, []).append(number)
        detections += _people(content, video, number, str(file))
    frames = {}
    for video, present in numbers.items():
        present.sort()
        step = present[1] - present[0] if len(present) > 1 else 1
        for before, after in pairwise(present):
            if after - before != step or step == 0:
                raise MotionFileError(
                    f"{path}: expected frames in steps of {max(step, 1)}, got {before} and {after}"
                )
        frames[video] = range(present[0], present[-1] + 1, step)
    return detections, frames


def _load(path: Path) -> Any:
    content = read_bytes(path)
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise MotionFileError(f"{path}: expected JSON ({str(error)[:80]})") from error


def _dicts(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise MotionFileError(f"{where} must be a list of objects, got {shortened(value)}")
    return value


def _all_have(items: Iterable[Any], key: str) -> bool:
    """Return whether ``items`` is nonempty and consists of objects with ``key``."""
    listed = list(items)
    return bool(listed) and all(isinstance(item, dict) and key in item for item in listed)


def _identity(item: dict[str, Any], keys: tuple[str, ...], where: str) -> str | None:
    """Return the first value among ``keys`` as text; None if missing or -1 (OpenPose)."""
    value = next((item[key] for key in keys if item.get(key) is not None), None)
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if value is None or value == [] or value == -1:
        return None
    if not isinstance(value, int | str):
        raise MotionFileError(f"{where}: {keys[0]} must be int or str, got {shortened(value)}")
    return str(value)


def _category_skeleton(content: dict[str, Any], path: Path) -> Skeleton | None:
    """Return the skeleton of the annotated COCO categories, None if they have none.

    Categories with the joints of a preset use its parents. Other categories use a spanning tree of
    the file's edges, which generally contain cycles.
    """
    where = f"{path}, categories"
    used = {_identity(person, ("category_id",), where) for person in content["annotations"]}
    skeletons: list[Skeleton] = []
    for category in _dicts(content.get("categories", []), where):
        names = category.get("keypoints")
        if _identity(category, ("id",), where) not in used or not names:
            continue
        where = f"{path}, category {shortened(category.get('name'))}"
        try:
            skeletons.append(_named_skeleton(names, category.get("skeleton") or []))
        except (ValueError, TypeError) as error:
            raise MotionFileError(f"{where}: {str(error)[:200]}") from error
        if skeletons[-1] != skeletons[0]:
            raise MotionFileError(f"{where}: expected the keypoints of the previous category")
    return skeletons[0] if skeletons else None


def _named_skeleton(names: list[str], edges: list[list[int]]) -> Skeleton:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"keypoints must be a list of names, got {shortened(names)}")
    rootless = Skeleton(names, [-1] * len(names))
    for preset in map(Skeleton.preset, PRESETS):
        if preset.canonical_names == rootless.canonical_names:
            return Skeleton(names, preset.parents)
    neighbours: list[list[int]] = [[] for _ in names]
    for first, second in edges:
        if not {first, second} <= set(range(1, len(names) + 1)):
            raise ValueError(
                f"skeleton must have edges between keypoints 1 to {len(names)}, got "
                f"{shortened([first, second])}"
            )
        neighbours[int(first) - 1].append(int(second) - 1)
        neighbours[int(second) - 1].append(int(first) - 1)
    parents: dict[int, int] = {}
    for root in range(len(names)):
        queue = [] if root in parents else [root]
        parents.setdefault(root, -1)
        for joint in queue:  # breadth-first search; grows in the loop
            for neighbour in neighbours[joint]:
                if neighbour not in parents:
                    parents[neighbour] = joint
                    queue.append(neighbour)
    return Skeleton(names, [parents[joint] for joint in range(len(names))])


def _checked_skeleton(skeleton: Skeleton | None, counts: list[int], path: Path) -> Skeleton:
    """Return the given or the default skeleton of ``counts[0]`` keypoints."""
    if not counts:
        raise MotionFileError(f"{path}: expected at least one person, got none")
    (count,) = counts
    if skeleton is None:
        if count not in _BY_COUNT:
            wanted = f"{count} keypoints{_TWO_LAYOUTS.get(count, '')}"
            raise MotionFileError(f"{path}: skeleton must be given for {wanted}, got None")
        return Skeleton.preset(_BY_COUNT[count])
    if skeleton.n_joints != count:
        raise MotionFileError(
            f"{path}: expected {skeleton.n_joints} keypoints as in skeleton, got {count}"
        )
    return skeleton


def _described(content: Any) -> str:
    if isinstance(content, dict):
        return f"the keys {', '.join(key[:40] for key in list(content)[:8])}"
    return f"a {type(content).__name__} with {shortened(content)}"

"""Reader of keypoint tracks in JSON: COCO, AlphaPose and OpenPose.

=====================  ==========================================================================
format                 content
=====================  ==========================================================================
COCO annotations       ``{"images": […], "annotations": [{"image_id", "keypoints", …}], …}``
COCO results           ``[{"image_id": "12.jpg", "keypoints": [x, y, confidence, …]}, …]``
AlphaPose              as COCO results, with the track id in ``"idx"``; of merged detections, a
                       list of ids, of which the first is used
AlphaPose "open",      ``{"12.jpg": {"people": [{"pose_keypoints_2d": […]}]}, …}``,
AlphaPose "cmu"        ``{"12.jpg": {"bodies": [{"joints": […]}]}, …}``
OpenPose               a folder of files ``{"people": [{"pose_keypoints_2d": […]}]}``, one per
                       frame; one such file; or a list of frames in one file
=====================  ==========================================================================

For other JSON, see :mod:`~probmotion.io.keypoints.mmpose` and
:mod:`~probmotion.io.keypoints.mediapipe`.

Keypoints have the layout named in the file, or else that of
:mod:`~probmotion.io.keypoints.layouts`.

In COCO annotations and OpenPose files, the listed images are the frames. The other formats list
only images with a detection: the frame is the last number in the image's name, and tracks include
all frames from the first to the last. Keypoints of confidence 0 are NaN. The visibility v of COCO
annotations becomes the confidence v/2: 0 not labelled, 0.5 occluded, 1 visible. Confidences of
AlphaPose, which are up to 6 in its models of COCO, are clipped to 1 in files with ``"idx"``, or
with a ``"version"`` that begins with AlphaPose.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import MotionFileError, read_bytes, shortened
from probmotion.io.keypoints.frames import declared_size
from probmotion.io.keypoints.layouts import keypoint_file
from probmotion.io.keypoints.mediapipe import read_landmarks
from probmotion.io.keypoints.mmpose import read_mmpose
from probmotion.io.keypoints.tracks import (
    Detection,
    KeypointFile,
    Parsed,
    frame_number,
    keypoint_values,
    named_skeleton,
    natural,
)
from probmotion.motion.skeleton import Skeleton

__all__ = ["read_json"]

_HIGHEST = 6.0  # confidence of AlphaPose


def read_json(
    path: Path,
    fps: float | None = None,
    skeleton: Skeleton | None = None,
    people: int | None = None,
    image_size: tuple[float, float] | None = None,
) -> KeypointFile:
    """Read the keypoint track of every person in a JSON file or an OpenPose or MMPose folder.

    People are identified by ``track_id``, ``idx`` or ``person_id``; otherwise frames must contain
    one person, unless ``people`` is given. An id that all people share (AlphaPose without tracking)
    does not identify them. For the arguments, see
    :func:`~probmotion.io.files.open_keypoints`.

    Raises
    ------
    MotionFileError
        If the file contains no keypoint tracks or is damaged.
    ValueError
        If ``people`` exceeds the largest number of people in an image.
    """
    if path.is_dir():
        parsed = _folder(path)
    else:
        content = _load(path)
        parsed = (
            read_landmarks(content, path, image_size)
            or read_mmpose(content, path)
            or _parsed(content, path)
        )
    return keypoint_file(parsed, path, fps, skeleton, people)


def _parsed(content: Any, path: Path) -> Parsed:
    """Return the detections of a file of COCO, AlphaPose or OpenPose."""
    if isinstance(content, dict) and "annotations" in content:
        return _annotations(content, path)
    if isinstance(content, dict) and "people" in content:
        return Parsed("OpenPose", _people(content, "", 0, f"{path}"), {"": range(1)})
    detections: list[Detection] = []
    if isinstance(content, list) and _all_have(content, "people"):
        for index, frame in enumerate(content):
            detections += _people(frame, "", index, f"{path}, frame {index}")
        return Parsed("OpenPose", detections, {"": range(len(content))})
    if isinstance(content, list) and _all_have(content, "keypoints"):
        return _results(content, path)
    if isinstance(content, dict) and (
        _all_have(content.values(), "people") or _all_have(content.values(), "bodies")
    ):
        for image, frame in content.items():
            video, index = frame_number(image, f"{path}, image")
            detections += _people(frame, video, index, f"{path}, {shortened(image)}")
        return Parsed("AlphaPose", detections)
    raise MotionFileError(
        f"{path}: expected keypoints of COCO (annotations, or a list with image_id and "
        f"keypoints), AlphaPose, OpenPose (people), MMPose (instances), RTMPose (keypoints and "
        f"scores) or MediaPipe (pose_landmarks), got {_described(content)}"
    )


def _annotations(content: dict[str, Any], path: Path) -> Parsed:
    """Return the detections of COCO annotations."""
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
    frames = {video: range(count) for video, count in length.items()}
    skeleton = _category_skeleton(content, path)
    sizes = {declared_size(image, path) for image in images}
    size = sizes.pop() if len(sizes) == 1 else None
    return Parsed("COCO annotations", detections, frames, skeleton, image_size=size)


def _results(content: list[dict[str, Any]], path: Path) -> Parsed:
    """Return the detections of COCO results or AlphaPose's default format."""
    alphapose = _all_have(content, "idx")
    detections = []
    for number, person in enumerate(content):
        where = f"{path}, [{number}]"
        location = frame_number(person.get("image_id"), f"{where}, image_id")
        values = _values(person["keypoints"], alphapose, where)
        merged = person.get("idx")
        while isinstance(merged, list) and merged:
            merged = merged[0]
        track_id = _identity(person | {"idx": merged}, ("track_id", "idx"), where)
        detections.append(Detection(*location, track_id, values, where))
    return Parsed("AlphaPose" if alphapose else "COCO results", detections)


def _people(frame: dict[str, Any], video: str, number: int, where: str) -> list[Detection]:
    """Return the detections of one frame in the OpenPose or a similar AlphaPose format."""
    key = "people" if "people" in frame else "bodies"
    alphapose = str(frame.get("version")).startswith("AlphaPose")
    detections = []
    for index, person in enumerate(_dicts(frame[key], f"{where}, {key}")):
        location = f"{where}, {key}[{index}]"
        names = ("pose_keypoints_2d", "pose_keypoints", "joints")
        keypoints = next((person[name] for name in names if name in person), None)
        if keypoints == []:  # only a face or a hand
            continue
        track_id = _identity(person, ("person_id", "idx", "track_id"), location)
        values = _values(keypoints, alphapose, location)
        detections.append(Detection(video, number, track_id, values, location))
    return detections


def _values(keypoints: Any, alphapose: bool, where: str) -> np.ndarray:
    """Return keypoints (J, 3), with confidences of AlphaPose clipped to 1."""
    values = keypoint_values(keypoints, where)
    if alphapose and values[:, 2].max() <= _HIGHEST:
        values[:, 2] = values[:, 2].clip(max=1)
    return values


def _folder(path: Path) -> Parsed:
    """Return the detections of a folder of OpenPose or MMPose with evenly spaced file numbers."""
    files = sorted(path.glob("*.json"), key=lambda file: natural(file.name))
    if not files:
        raise MotionFileError(
            f"{path}: expected .json files of OpenPose or MMPose, one per frame, got none"
        )
    name = "OpenPose"
    detections: list[Detection] = []
    numbers: dict[str, list[int]] = {}
    for file in files:
        content = _load(file)
        openpose = isinstance(content, dict) and "people" in content
        image = None if openpose else read_mmpose(content, file)
        if not openpose and image is None and content != []:  # an image without people
            raise MotionFileError(
                f"{file}: expected a frame of OpenPose or MMPose, got {_described(content)}"
            )
        video, number = frame_number(file.name, str(file))
        numbers.setdefault(video, []).append(number)
        if openpose:
            detections += _people(content, video, number, str(file))
        elif image is not None:
            name = image.format
            detections += [replace(one, video=video, frame=number) for one in image.detections]
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
    return Parsed(name, detections, frames)


def _load(path: Path) -> Any:
    content = read_bytes(path)
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = str(error)[:80] if content else "the file is empty"
        raise MotionFileError(f"{path}: expected JSON ({reason})") from error


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
            edges = [[joint - 1 for joint in edge] for edge in category.get("skeleton") or []]
            skeletons.append(named_skeleton(names, edges))
        except TypeError as error:
            raise MotionFileError(
                f"{where}: skeleton must have pairs of keypoints, got "
                f"{shortened(category['skeleton'])}"
            ) from error
        except ValueError as error:
            raise MotionFileError(f"{where}: {str(error)[:200]}") from error
        if skeletons[-1] != skeletons[0]:
            raise MotionFileError(f"{where}: expected the keypoints of the previous category")
    return skeletons[0] if skeletons else None


def _described(content: Any) -> str:
    if isinstance(content, dict):
        keys = ", ".join(key[:40] for key in list(content)[:8])
        return f"the keys {keys}" if keys else "an empty object"
    return f"a {type(content).__name__} with {shortened(content)}"

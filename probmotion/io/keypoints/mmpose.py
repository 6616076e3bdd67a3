"""Reader of JSON files of MMPose and of RTMPose (rtmlib).

================  ===============================================================================
format            content
================  ===============================================================================
MMPose            ``{"meta_info": …, "instance_info": [{"frame_id", "instances": […]}, …]}``;
                  ``[{"frame_id", "instances": [{"keypoints", "keypoint_scores"}, …]}, …]``; or
                  the instances of one image
RTMPose (rtmlib)  ``[{"keypoints": (P, J, 2), "scores": (P, J)}, …]``, an entry per frame, with
                  the keypoints of P people, of one, or of each of the list ``people``; or
                  ``{"keypoints": (L, P, J, 2), "scores": (L, P, J)}``
================  ===============================================================================

Lists of frames may be the entry ``frames`` of an object with ``fps``. Frames are numbered as in
:mod:`~probmotion.io.keypoints.frames`. Scores are clipped to 0 to 1, since those of RTMPose are not
probabilities.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import MotionFileError, shortened
from probmotion.io.keypoints.frames import FRAME, Person, matrix_of, numbered_frames, value_of
from probmotion.io.keypoints.tracks import Parsed, named_skeleton
from probmotion.motion.skeleton import Skeleton

__all__ = ["read_mmpose"]

_LISTS = ("instance_info", "frames")
_PEOPLE = ("instances", "people", "persons")
_SCORES = ("keypoint_scores", "scores")


def read_mmpose(content: Any, path: Path) -> Parsed | None:
    """Return the detections of a JSON file; None if it has another format.

    Raises
    ------
    MotionFileError
        If the file is damaged.
    """
    header: dict[str, Any] = content if isinstance(content, dict) else {}
    entries = next((header[key] for key in _LISTS if _are_frames(header.get(key))), None)
    if entries is None and _depth(header.get("keypoints")) == 4:
        entries = _frame_by_frame(header, path)
    if entries is None:
        entries = [content] if header else content
    if not _are_frames(entries):
        return None
    if all(
        value_of(entry, ("keypoint_scores",)) and not value_of(entry, FRAME) for entry in entries
    ):
        entries = [{"instances": entries}]  # the people of one image
    frames = [list(_people(entry, f"{path}, frame {k}")) for k, entry in enumerate(entries)]
    mmpose = any(value_of(entry, ("instances",)) is not None for entry in entries)
    skeleton = _declared_skeleton(header.get("meta_info"), path)
    name = "MMPose" if mmpose else "RTMPose (rtmlib)"
    return numbered_frames(name, entries, frames, skeleton, header, path)


def _are_frames(entries: Any) -> bool:
    return isinstance(entries, list) and any(map(_is_frame, entries))


def _is_frame(entry: Any) -> bool:
    """Return whether a frame has the keypoints of people of this format."""
    if not isinstance(entry, dict) or "image_id" in entry:  # results of COCO
        return False
    people = value_of(entry, _PEOPLE)
    first = people[0] if isinstance(people, list) and people else entry
    scored = value_of(first, _SCORES) is not None and "keypoints" in first
    nested = isinstance(first, dict) and _depth(first.get("keypoints")) > 1
    return "instances" in entry or scored or nested


def _frame_by_frame(content: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    keypoints, scores = content["keypoints"], value_of(content, _SCORES)
    if not isinstance(scores, list) or len(scores) != len(keypoints):
        raise MotionFileError(
            f"{path}: expected scores of {len(keypoints)} frames, got {shortened(scores)}"
        )
    return [{"keypoints": k, "scores": s} for k, s in zip(keypoints, scores, strict=True)]


def _people(entry: Any, where: str) -> Iterator[Person]:
    """Yield the people of a frame of MMPose or rtmlib."""
    if entry is None or entry == []:
        return
    if not isinstance(entry, dict):
        raise MotionFileError(f"{where} must be an object, got {shortened(entry)}")
    people = value_of(entry, _PEOPLE)
    if people is None:
        people = [entry] if entry.get("keypoints") else []
        if people and _depth(entry["keypoints"]) == 3:  # of several people
            scores = value_of(entry, _SCORES)
            given = scores if isinstance(scores, list) else []
            if given and len(given) != len(entry["keypoints"]):
                raise MotionFileError(
                    f"{where}: expected scores of {len(entry['keypoints'])} people, got "
                    f"{shortened(scores)}"
                )
            people = [
                {"keypoints": points, "scores": given[k] if given else None}
                for k, points in enumerate(entry["keypoints"])
            ]
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise MotionFileError(f"{where}: expected a list of people, got {shortened(people)}")
    for k, person in enumerate(people):
        at = f"{where}, person {k}"
        points = matrix_of(person.get("keypoints"), at)
        scores = value_of(person, _SCORES)
        if scores is not None:
            column = matrix_of([scores], at)
            if column.size != len(points) or points.shape[1] != 2:
                raise MotionFileError(
                    f"{at}: expected x and y of {column.size} keypoints, as many as scores, got "
                    f"shape {points.shape}"
                )
            points = np.column_stack([points, column.ravel()])
        if points.shape[1] != 3:
            raise MotionFileError(f"{at}: expected keypoint_scores or scores, got none")
        yield points, value_of(person, ("track_id", "person_id"))


def _declared_skeleton(meta: Any, path: Path) -> Skeleton | None:
    """Return the skeleton of MMPose's ``meta_info``, None if it has no names."""
    names = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    if not names:
        return None
    links = meta.get("skeleton_links") or []
    try:
        ordered = [names[str(k)] for k in range(len(names))]
        # Halpe's 26 keypoints have the top of the head as "head".
        ordered = ["head_top" if name == "head" else name for name in ordered]
        return named_skeleton(ordered, [[int(joint) for joint in link] for link in links])
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise MotionFileError(
            f"{path}, meta_info: expected names of keypoints ({str(error)[:200]})"
        ) from error


def _depth(value: Any) -> int:
    depth = 0
    while isinstance(value, list) and value:
        depth, value = depth + 1, value[0]
    return depth

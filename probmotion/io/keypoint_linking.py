"""Tracking of people across images by their keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.io.keypoint_tracks import Detection

__all__ = ["link_people"]


def link_people(detections: Sequence[Detection], people: int) -> list[Detection]:
    """Return the detections of ``people`` people, with track ids ``"0"``, ``"1"``, …

    Tracking starts at a video's first image with at least that many people, where the most
    confident
    ones are numbered from left to right, and proceeds forwards and backwards. In every other image,
    detections are assigned to people by the minimum total keypoint distance from their expected
    positions (Hungarian method), extrapolated with constant velocity. Other detections are dropped.
    People who swap places during occlusion may be confused.
    """
    videos: dict[str, dict[int, list[Detection]]] = {}
    for detection in detections:
        videos.setdefault(detection.video, {}).setdefault(detection.frame, []).append(detection)
    linked: list[Detection] = []
    for frames in videos.values():
        order = sorted(frames)
        full = [number for number in order if len(frames[number]) >= people]
        if not full:
            most = max(len(found) for found in frames.values())
            raise ValueError(f"people must be at most {most}, as in one image, got {people}")
        confident = sorted(frames[full[0]], key=lambda found: -found.values[:, 2].mean())[:people]
        first = sorted(confident, key=lambda found: float(_middle(found.values)[0]))
        named = {full[0]: dict(enumerate(first))}
        at = order.index(full[0])
        for way in (order[at + 1 :], order[:at][::-1]):
            followed = [_Person(found) for found in first]
            for number in way:
                named[number] = _assigned(frames[number], followed, number)
                for person, found in named[number].items():
                    followed[person] = _Person(found, followed[person].last)
        for number in order:
            linked += [replace(found, person=str(k)) for k, found in sorted(named[number].items())]
    return linked


class _Person:
    """Last detection of a person and the velocity of its mean keypoint."""

    def __init__(self, last: Detection, before: Detection | None = None) -> None:
        self.last = last
        self.step = np.zeros(2)
        if before is not None:
            self.step = _middle(last.values) - _middle(before.values)
            self.step /= last.frame - before.frame

    def expected(self, frame: int) -> np.ndarray:
        values = self.last.values.copy()
        values[:, :2] += self.step * (frame - self.last.frame)
        return values


def _assigned(found: list[Detection], followed: list[_Person], frame: int) -> dict[int, Detection]:
    from scipy.optimize import linear_sum_assignment

    where = [person.expected(frame) for person in followed]
    cost = np.array([[_distance(expected, one.values) for one in found] for expected in where])
    return {int(k): found[int(one)] for k, one in zip(*linear_sum_assignment(cost), strict=True)}


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the mean distance of common keypoints, or of the mean keypoints if there are none."""
    both = (first[:, 2] > 0) & (second[:, 2] > 0)
    if not both.any():
        return float(np.linalg.norm(_middle(first) - _middle(second)))
    return float(np.linalg.norm(first[both, :2] - second[both, :2], axis=-1).mean())


def _middle(values: np.ndarray) -> np.ndarray:
    """Return the mean of the detected keypoints, (2,); 0 if there is none."""
    seen = values[:, 2] > 0
    return values[seen, :2].mean(axis=0) if seen.any() else np.zeros(2)

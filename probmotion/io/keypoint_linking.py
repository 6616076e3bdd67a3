"""Tracking of people across images by their keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.io.keypoint_tracks import Detection

__all__ = ["link_people"]


def link_people(detections: Sequence[Detection], people: int) -> list[Detection]:
    """Return the detections of ``people`` people, with track ids ``"0"``, ``"1"``, …

    Tracking starts at the first image of a video with at least ``people`` detections and proceeds
    forwards and backwards. In this image, the most confident detections are numbered from left to
    right. In every other image, the Hungarian method assigns detections to people: it minimises
    the total distance to keypoints extrapolated at constant velocity. Unassigned detections are
    dropped. People who swap positions during occlusion may be confused.
    """
    videos: dict[str, dict[int, list[Detection]]] = {}
    for detection in detections:
        videos.setdefault(detection.video, {}).setdefault(detection.frame, []).append(detection)
    linked: list[Detection] = []
    for frames in videos.values():
        order = sorted(frames)
        full = [number for number in order if len(frames[number]) >= people]
        if not full:
            most = max(map(len, frames.values()))
            raise ValueError(f"people must be at most {most}, the most in any image, got {people}")
        confident = sorted(frames[full[0]], key=lambda one: -one.values[:, 2].mean())[:people]
        first = sorted(confident, key=lambda one: float(_middle(one.values)[0]))
        tracked = {full[0]: dict(enumerate(first))}
        start = order.index(full[0])
        for numbers in (order[start + 1 :], order[:start][::-1]):
            recent: list[tuple[Detection, Detection | None]] = [(one, None) for one in first]
            for number in numbers:
                expected = [_expected(*pair, number) for pair in recent]
                tracked[number] = _assigned(frames[number], expected)
                for person, one in tracked[number].items():
                    recent[person] = one, recent[person][0]
        for number in order:
            linked += [replace(one, person=str(k)) for k, one in sorted(tracked[number].items())]
    return linked


def _expected(last: Detection, before: Detection | None, frame: int) -> np.ndarray:
    """Return keypoints (J, 3) of a person, moved to ``frame`` at the velocity of their mean."""
    values = last.values.copy()
    if before is not None:
        step = _middle(last.values) - _middle(before.values)
        step /= last.frame - before.frame
        values[:, :2] += step * (frame - last.frame)
    return values


def _assigned(detections: list[Detection], expected: list[np.ndarray]) -> dict[int, Detection]:
    """Return the detection assigned to each person, by index of the person."""
    from scipy.optimize import linear_sum_assignment

    cost = np.array([[_distance(where, one.values) for one in detections] for where in expected])
    return {int(k): detections[i] for k, i in zip(*linear_sum_assignment(cost), strict=True)}


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the mean distance of keypoints detected in both, else of the mean keypoints."""
    both = (first[:, 2] > 0) & (second[:, 2] > 0)
    if not both.any():
        return float(np.linalg.norm(_middle(first) - _middle(second)))
    return float(np.linalg.norm(first[both, :2] - second[both, :2], axis=-1).mean())


def _middle(values: np.ndarray) -> np.ndarray:
    """Return the mean of the detected keypoints, (2,); 0 if none is detected."""
    seen = values[:, 2] > 0
    return values[seen, :2].mean(axis=0) if seen.any() else np.zeros(2)

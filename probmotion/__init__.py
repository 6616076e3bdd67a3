"""One posterior over 3D skeletal motion, many samplers.

Public names are imported when they are first used, so that ``import probmotion`` stays fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from probmotion.cameras import Cameras
    from probmotion.comparison import Comparison, compare
    from probmotion.diffusion import NoiseSchedule
    from probmotion.draws import MotionDraws
    from probmotion.likelihoods import Joints3D, Keypoints2D
    from probmotion.motion import KeypointTrack, Motion, load_motion, load_motions
    from probmotion.posterior import MotionPosterior
    from probmotion.sampling import Sampler, UnsupportedPosterior
    from probmotion.skeleton import Skeleton
    from probmotion.triangulation import triangulate

_HOMES = {
    "Cameras": "cameras",
    "Comparison": "comparison",
    "Joints3D": "likelihoods",
    "KeypointTrack": "motion",
    "Keypoints2D": "likelihoods",
    "Motion": "motion",
    "MotionDraws": "draws",
    "MotionPosterior": "posterior",
    "NoiseSchedule": "diffusion",
    "Sampler": "sampling",
    "Skeleton": "skeleton",
    "UnsupportedPosterior": "sampling",
    "compare": "comparison",
    "load_motion": "motion",
    "load_motions": "motion",
    "triangulate": "triangulation",
}

__all__ = [
    "Cameras",
    "Comparison",
    "Joints3D",
    "KeypointTrack",
    "Keypoints2D",
    "Motion",
    "MotionDraws",
    "MotionPosterior",
    "NoiseSchedule",
    "Sampler",
    "Skeleton",
    "UnsupportedPosterior",
    "compare",
    "load_motion",
    "load_motions",
    "triangulate",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"probmotion.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'probmotion' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])

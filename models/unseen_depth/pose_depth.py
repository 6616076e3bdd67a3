"""Regression of the depths of joints and the pitch of the camera on keypoints of a few frames.

One view does not determine the depths of joints. The prior of a motion models only their linear
covariance with the keypoints; the regression is nonlinear. Its input is relative to the apparent
size of the body, so that it requires neither focal length nor distance. A bone that seems shorter
than usual is inclined: the input contains the difference of its ends' depths for a bone of usual
length, without sign.

An image and its mirror image, in which left and right are exchanged, have the same depths. The
estimate is therefore the mean of both. The network was trained on videos and their mirror images:
where its two estimates differ, postures are unlike those on which it was trained.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probmotion.files import read_arrays, written_whole
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_shape

__all__ = [
    "BONES", "FRAMES", "INPUTS", "KEYPOINTS", "RATE", "DepthEstimate", "PoseDepth",
    "network_inputs", "relative_keypoints",
]  # fmt: skip

_PERSON = Skeleton.preset("person14")
KEYPOINTS = tuple(j for j, name in enumerate(_PERSON.joint_names) if name not in ("neck", "pelvis"))
"""Joints of ``person14`` that are seen and estimated: those of arms and legs."""
FRAMES = 9
"""Frames of an input; the estimate is for the one in the middle."""
RATE = 15.0
"""Frames per second of an input."""
BONES = {
    f"{side}_{end}": (f"{side}_{start}", length)
    for side in ("left", "right")
    for start, end, length in (
        ("shoulder", "elbow", 0.28),
        ("elbow", "wrist", 0.21),
        ("hip", "knee", 0.42),
        ("knee", "ankle", 0.41),
    )
}
"""Bones of arms and legs by their ends: their starts and usual lengths in metres."""
_FAR = 2.0  # largest distance of a keypoint from the middle of the body, metres
_FORMAT = 1
_WEIGHTS = Path(__file__).parents[1] / "weights"
_MIRRORED = [KEYPOINTS.index(_PERSON.mirrored_order[j]) for j in KEYPOINTS]
_DISTANCES = (
    *((start, end, length) for end, (start, length) in BONES.items()),
    ("left_shoulder", "right_shoulder", 0.37),
    ("left_hip", "right_hip", 0.2),
    ("left_shoulder", "left_hip", 0.5),
    ("right_shoulder", "right_hip", 0.5),
)
_STARTS, _ENDS = (
    [KEYPOINTS.index(_PERSON.joint_names.index(pair[i])) for pair in _DISTANCES] for i in (0, 1)
)
_LENGTHS = np.array([length for _, _, length in _DISTANCES])
INPUTS = FRAMES * (3 * len(KEYPOINTS) + 2 * len(_DISTANCES))
"""Inputs of the network."""


class DepthEstimate(NamedTuple):
    """Depths of joints behind the middle of the hips along the ray to the body, and its pitch.

    The ray is that to the middle of the body in the image. ``depth`` and its standard deviation
    ``spread`` are (L, J), metres, as is ``disagreement``, the distance from ``depth`` of the
    estimates from the image alone and from the mirror image alone. ``pitch`` is the angle of the
    ray above the horizon, ``pitch_spread`` its standard deviation, (L,), radians.
    """

    depth: np.ndarray
    spread: np.ndarray
    disagreement: np.ndarray
    pitch: np.ndarray
    pitch_spread: np.ndarray


def relative_keypoints(
    points: np.ndarray, visible: np.ndarray, middle: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Return the keypoints of each frame for the regression, (L, 3 J).

    Parameters
    ----------
    points : ndarray, (L, J, 2)
        Keypoints, pixels with y down.
    visible : ndarray of bool, (L, J)
        Which keypoints are known.
    middle : ndarray, (L, 2)
        Middle of the body, pixels.
    size : ndarray, (L,)
        Apparent size of the body, pixels per metre.

    Returns
    -------
    ndarray
        Positions about the middle, right and up, metres, 0 where unknown; then which are known.
    """
    metres = (points - middle[:, None]) / size[:, None, None] * [1.0, -1.0]
    metres = np.clip(np.where(visible[..., None], metres, 0.0), -_FAR, _FAR)
    return np.concatenate([metres.reshape(len(points), -1), visible], axis=1)


def network_inputs(windows: np.ndarray) -> np.ndarray:
    """Return the inputs of the network: ``(n, FRAMES, 3 J) → (n, inputs)``.

    ``windows`` are :func:`relative_keypoints`. Unknown positions are interpolated between the
    frames in which the joint is known, those before the first and after the last are as in these,
    and a joint that is never known is at 0. The bones of arms and legs, the hips, the shoulders and
    the sides of the trunk have a usual length l and an apparent length d: √max(l² − d², 0)
    estimates the difference of the depths of the ends without its sign, and √max(d² − l², 0) says
    that the body is larger, or a keypoint wrong.
    """
    n, J = len(windows), len(KEYPOINTS)
    points = windows[..., : 2 * J].reshape(n, FRAMES, J, 2)
    known = windows[..., 2 * J :] > 0
    frames = np.arange(FRAMES)[:, None]
    last = np.maximum.accumulate(np.where(known, frames, -1), axis=1)
    following = np.minimum.accumulate(np.where(known, frames, FRAMES)[:, ::-1], axis=1)[:, ::-1]
    # A joint that is never known is 0 in every frame.
    before = np.minimum(np.where(last < 0, following, last), FRAMES - 1)[..., None]
    after = np.maximum(np.where(following == FRAMES, last, following), 0)[..., None]
    share = (frames[..., None] - before) / np.maximum(after - before, 1)
    first, second = (np.take_along_axis(points, at, axis=1) for at in (before, after))
    filled = (1 - share) * first + share * second
    square = ((filled[:, :, _STARTS] - filled[:, :, _ENDS]) ** 2).sum(axis=-1) - _LENGTHS**2
    differences = [np.sqrt(np.maximum(sign * square, 0.0)) for sign in (-1, 1)]
    return np.concatenate([part.reshape(n, -1) for part in (filled, known, *differences)], axis=1)


@dataclass(frozen=True, eq=False)
class PoseDepth:
    """Network of the regression.

    Parameters
    ----------
    layers : sequence of (ndarray, ndarray)
        Weights (out, in) and offsets (out,): a first layer, residual layers and a linear last one,
        whose outputs are depths and pitch, then the logarithms of their mean absolute errors.
    card : mapping
        Notes on the training.
    """

    layers: Sequence[tuple[np.ndarray, np.ndarray]]
    card: Mapping[str, Any]

    def estimate(
        self,
        points: np.ndarray,
        visible: np.ndarray,
        middle: np.ndarray,
        size: np.ndarray,
        fps: float,
    ) -> DepthEstimate:
        """Return the estimates for L frames; parameters as of :func:`relative_keypoints`."""
        J = len(KEYPOINTS)
        check_shape("points", points, ("L", J, 2))
        frames = relative_keypoints(points, visible, middle, size)
        offsets = np.round(np.arange(-(FRAMES // 2), FRAMES // 2 + 1) * fps / RATE).astype(int)
        rows = np.clip(np.arange(len(frames))[:, None] + offsets, 0, len(frames) - 1)
        straight = self._outputs(network_inputs(frames[rows]))
        mirrored = self._outputs(network_inputs(_exchanged(frames)[rows]))
        order = [*_MIRRORED, J]
        first, second = straight[:, : J + 1], mirrored[:, order]
        mean, disagreement = (first + second) / 2, np.abs(first - second) / 2
        logs = (straight[:, J + 1 :] + mirrored[:, J + 1 :][:, order]) / 2
        # Errors have about a Laplace distribution.
        spread = np.sqrt(2.0) * np.exp(logs)
        return DepthEstimate(
            mean[:, :J], spread[:, :J], disagreement[:, :J], mean[:, J], spread[:, J]
        )

    def _outputs(self, inputs: np.ndarray) -> np.ndarray:
        """Return the outputs of the last layer: ``(n, inputs) → (n, 2 (J + 1))``."""
        (first, offset), *residual, (last, last_offset) = self.layers
        hidden = np.maximum(inputs @ first.T + offset, 0.0)
        for matrix, shift in residual:
            hidden = hidden + np.maximum(hidden @ matrix.T + shift, 0.0)
        outputs: np.ndarray = hidden @ last.T + last_offset
        return outputs

    def save(self, path: str | Path) -> None:
        """Write the network to an ``.npz`` file; weights are rounded to half precision."""
        header = np.array(json.dumps({"format": _FORMAT, "card": dict(self.card)}))
        arrays: dict[str, np.ndarray] = {}
        for number, (matrix, offset) in enumerate(self.layers):
            arrays |= {f"matrix{number}": matrix, f"offset{number}": offset}
        halves: dict[str, Any] = {name: array.astype(np.float16) for name, array in arrays.items()}
        with written_whole(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, header=header, **halves)

    @classmethod
    def load(cls, source: str | Path = "pose-depth") -> PoseDepth:
        """Read the shipped network by its name, or a file written by :meth:`save`.

        Raises
        ------
        ValueError
            If the file is not such a network.
        OSError
            If it cannot be read.
        """
        path = _WEIGHTS / f"{source}.npz" if source == "pose-depth" else Path(source)
        try:
            archive = read_arrays(path)
            header = json.loads(str(archive.pop("header")))
            if header["format"] != _FORMAT:
                raise ValueError(
                    f"format {header['format']}; learn it again: "
                    "python notebooks/ship_pose_depth.py --data DATA --out DIR"
                )
            floats = {
                name: array.astype(np.float64, casting="safe") for name, array in archive.items()
            }
            layers = [
                (floats[f"matrix{number}"], floats[f"offset{number}"])
                for number in range(len(floats) // 2)
            ]
            sizes = [INPUTS, *(len(offset) for _, offset in layers)]
            hidden, fits = sizes[1:-1], sizes[-1] == 2 * len(KEYPOINTS) + 2
            shapes = list(pairwise(sizes))
            fits &= len(set(hidden)) == 1 and len(floats) == 2 * len(layers)
            for (matrix, offset), (inputs, outputs) in zip(layers, shapes, strict=True):
                fits &= matrix.shape == (outputs, inputs) and offset.shape == (outputs,)
            if not fits or not all(np.isfinite(array).all() for array in floats.values()):
                raise ValueError("other layers")
            if not isinstance(header["card"], dict):
                raise TypeError("card")
        except (KeyError, TypeError, ValueError, IndexError, RecursionError) as error:
            raise ValueError(
                f"source must be a file written by PoseDepth.save, got {path.name} ({error})"
            ) from error
        return cls(layers, header["card"])


def _exchanged(frames: np.ndarray) -> np.ndarray:
    """Return the keypoints of the mirrored image with left and right exchanged, (L, 3 J)."""
    J = len(KEYPOINTS)
    points = frames[:, : 2 * J].reshape(-1, J, 2)[:, _MIRRORED] * [-1.0, 1.0]
    return np.concatenate([points.reshape(len(frames), -1), frames[:, 2 * J :][:, _MIRRORED]], 1)

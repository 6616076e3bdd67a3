"""2D annotations of several people in video frames.

Image coordinates are in metres at the scale of the people, with x right and y up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from probmotion.files import check_format, read_arrays, written_whole
from probmotion.interaction.annotations.local_frames import chest_joints, joint_roots
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive, check_shape

__all__ = ["Annotations"]


@dataclass(frozen=True, eq=False)
class Annotations:
    """Set of n annotated frames of K people, whose skeleton has K trees and J joints.

    Parameters
    ----------
    keypoints : ndarray, (n, J, 2)
        2D positions, metres, x right, y up. Values of occluded joints are ignored and set to 0.
    visible : ndarray, (n, J), bool
        Mask of annotated joints, with at least one per person in every frame.
    skeleton : Skeleton
        Names and parents of the J joints.
    neighbours : ndarray, (n, 2, J, 2)
        2D positions in the previous and the next frame of the same video, metres; NaN at cuts, at
        the ends of the video and for occluded joints.
    fps : float
        Frames per second of the videos.
    views : ndarray, (n, 2), optional
        Camera views (φ, θ) of eq. 4, radians, NaN if unknown. They can be estimated with
        :func:`~probmotion.interaction.annotations.backbones.annotation_views`.
    sources : sequence of str, optional
        Name of the video of each annotation.
    dropped : mapping of str to int
        Number of frames dropped by a loader, by reason.
    """

    keypoints: np.ndarray
    visible: np.ndarray
    skeleton: Skeleton
    neighbours: np.ndarray
    fps: float
    views: np.ndarray | None = None
    sources: Sequence[str] | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        keypoints = np.asarray(self.keypoints, dtype=np.float64)
        check_shape("keypoints", keypoints, ("n", self.skeleton.n_joints, 2))
        n = len(keypoints)
        if n == 0:
            raise ValueError("keypoints must contain at least one annotation, got none")
        visible = np.asarray(self.visible)
        check_shape("visible", visible, keypoints.shape[:2])
        if visible.dtype != np.bool_:
            raise ValueError(f"visible must be bool, got {visible.dtype}")
        missing = ~np.isfinite(keypoints).all(axis=-1) & visible
        if missing.any():
            index, joint = np.argwhere(missing)[0]
            raise ValueError(
                "keypoints must be finite where visible, got "
                f"{keypoints[index, joint]} in annotation {index}, joint "
                f"{self.skeleton.joint_names[joint]}"
            )
        for root in self.skeleton.roots:
            missing = ~visible[:, np.equal(joint_roots(self.skeleton), root)].any(axis=-1)
            if missing.any():
                raise ValueError(
                    "visible must have at least one joint per person, got none of the person of "
                    f"{self.skeleton.joint_names[root]} in annotation {int(np.argmax(missing))}"
                )
        for name, shape in (("neighbours", (n, 2, self.skeleton.n_joints, 2)), ("views", (n, 2))):
            if getattr(self, name) is None:
                continue
            values = np.asarray(getattr(self, name), dtype=np.float64)
            check_shape(name, values, shape)
            if np.isinf(values).any():
                raise ValueError(f"{name} must be finite, or NaN if unknown, got infinite values")
            object.__setattr__(self, name, values)
        check_positive("fps", self.fps)
        if self.sources is not None:
            sources = tuple(str(source) for source in self.sources)
            if len(sources) != n:
                raise ValueError(f"sources must have {n} names, got {len(sources)}")
            object.__setattr__(self, "sources", sources)
        object.__setattr__(self, "keypoints", np.where(visible[..., np.newaxis], keypoints, 0.0))
        object.__setattr__(self, "visible", visible)
        object.__setattr__(self, "fps", float(self.fps))
        object.__setattr__(self, "dropped", dict(self.dropped))

    def __len__(self) -> int:
        return len(self.keypoints)

    def subset(self, indices: Sequence[int] | np.ndarray) -> Annotations:
        """Return the annotations at ``indices`` (integers or a mask), in that order."""
        chosen = np.asarray(indices)
        if chosen.dtype == np.bool_:
            check_shape("indices", chosen, (len(self),))
            chosen = np.flatnonzero(chosen)
        elif chosen.size and not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(f"indices must be integers or a mask, got {chosen.dtype}")
        if chosen.size and (chosen.min() < 0 or chosen.max() >= len(self)):
            raise ValueError(
                f"indices must be from 0 to {len(self) - 1}, got {chosen.min()} to {chosen.max()}"
            )
        chosen = chosen.astype(np.int64)
        return replace(
            self,
            keypoints=self.keypoints[chosen],
            visible=self.visible[chosen],
            neighbours=self.neighbours[chosen],
            views=None if self.views is None else self.views[chosen],
            sources=None if self.sources is None else [self.sources[i] for i in chosen],
        )

    @classmethod
    def joined(cls, several: Sequence[Annotations]) -> Annotations:
        """Concatenate annotations of several videos with the same skeleton and frame rate.

        The result has views if all sets have them, and sources if any set has them.
        """
        if not several:
            raise ValueError("several must contain at least one set of annotations, got none")
        first = several[0]
        for number, other in enumerate(several):
            if other.skeleton != first.skeleton or other.fps != first.fps:
                raise ValueError(
                    f"several[{number}] must have the skeleton and frame rate of several[0], got "
                    f"{other.skeleton.n_joints} joints and {other.fps:g} frames per second"
                )
        views = [other.views for other in several if other.views is not None]
        names = [other.sources or [""] * len(other) for other in several]
        reasons = dict.fromkeys(reason for other in several for reason in other.dropped)
        return cls(
            np.concatenate([other.keypoints for other in several]),
            np.concatenate([other.visible for other in several]),
            first.skeleton,
            np.concatenate([other.neighbours for other in several]),
            first.fps,
            views=np.concatenate(views) if len(views) == len(several) else None,
            sources=[name for video in names for name in video] if any(map(any, names)) else None,
            dropped={r: sum(other.dropped.get(r, 0) for other in several) for r in reasons},
        )

    def describe(self) -> str:
        """Return a summary: the number of annotations, occluded joints and dropped frames."""
        occluded = int((~self.visible).sum())
        text = f"{len(self)} annotation{'s' * (len(self) != 1)}"
        text += f", {occluded} of {self.visible.size} joints occluded" if occluded else ""
        dropped = [f"{count} ({why})" for why, count in self.dropped.items() if count]
        return text + (f", frames dropped: {', '.join(dropped)}" if dropped else "")

    def local_differences(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of each bone's image direction and length per frame (Δp in eq. 12).

        The change is half the difference of the neighbours if both exist, the one-sided difference
        if one exists, and otherwise 0. The direction of a bone of length 0 is the zero vector.

        Returns
        -------
        turn : ndarray, (n, J)
            Norm of the change of the unit vector from the parent to the joint (at a root: from
            the root to the chest).
        stretch : ndarray, (n, J)
            Change of the bone's length (at a root: its displacement), metres.
        """
        current = np.where(self.visible[..., np.newaxis], self.keypoints, np.nan)
        times = np.stack([self.neighbours[:, 0], current, self.neighbours[:, 1]])
        base, tip = list(self.skeleton.parents), list(range(self.skeleton.n_joints))
        for root, chest in zip(self.skeleton.roots, chest_joints(self.skeleton), strict=True):
            base[root], tip[root] = root, chest
        bones = times[:, :, tip] - times[:, :, base]
        lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
        turn = _change(bones / np.where(lengths > 0, lengths, 1.0))
        stretch = _change(lengths)
        roots = list(self.skeleton.roots)
        stretch[:, roots] = _change(times[:, :, roots])
        return turn, stretch

    def save(self, path: str | Path) -> None:
        """Write the annotations to an ``.npz`` archive, atomically."""
        arrays: dict[str, np.ndarray] = {
            "format": np.array(1),
            "keypoints": self.keypoints,
            "visible": self.visible,
            "neighbours": self.neighbours,
            "fps": np.array(self.fps),
            "joint_names": np.array(self.skeleton.joint_names),
            "parents": np.array(self.skeleton.parents, dtype=np.int32),
            "dropped_reasons": np.array(list(self.dropped), dtype=np.str_),
            "dropped_counts": np.array(list(self.dropped.values()), dtype=np.int64),
        }
        if self.skeleton.radii is not None:
            arrays["radii"] = np.array(self.skeleton.radii)
        if self.views is not None:
            arrays["views"] = self.views
        if self.sources is not None:
            arrays["sources"] = np.array(self.sources, dtype=np.str_)
        with written_whole(Path(path)) as unfinished, open(unfinished, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Annotations:
        """Read an archive written by :meth:`save`; raise ``ValueError`` if it is damaged."""
        try:
            arrays = read_arrays(path)
            check_format(arrays)
            skeleton = Skeleton(
                arrays["joint_names"].tolist(),
                arrays["parents"].tolist(),
                arrays["radii"].tolist() if "radii" in arrays else None,
            )
            counts = arrays["dropped_counts"].tolist()
            return cls(
                arrays["keypoints"],
                arrays["visible"],
                skeleton,
                arrays["neighbours"],
                arrays["fps"].item(),
                views=arrays.get("views"),
                sources=arrays["sources"].tolist() if "sources" in arrays else None,
                dropped=dict(zip(arrays["dropped_reasons"].tolist(), counts, strict=True)),
            )
        except (ValueError, KeyError, TypeError, AttributeError) as err:
            raise ValueError(
                f"{path} must be an archive written by Annotations.save, got an unreadable file "
                f"({str(err)[:120]})"
            ) from err


def _change(values: np.ndarray) -> np.ndarray:
    """Return the norm of the change per frame from three frames, ``(3, …, d) → (…)``."""
    before, current, after = values
    result = np.zeros(current.shape[:-1])
    # In order of increasing preference; a difference is NaN if either frame is missing.
    for change in (after - current, current - before, (after - before) / 2):
        size = np.linalg.norm(change, axis=-1)
        result = np.where(np.isnan(size), result, size)
    return result

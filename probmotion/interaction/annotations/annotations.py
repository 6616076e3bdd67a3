"""Annotated 2D pose-pairs: joints of several characters in single frames of videos.

Image axes are x right and y up, in metres: the scale of the characters, not of the camera.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from probmotion.files import written_whole
from probmotion.interaction.annotations.local_frames import chests, trees
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive, check_shape

__all__ = ["Annotations"]


@dataclass(frozen=True, eq=False)
class Annotations:
    """n annotated frames of K characters, the joints of one skeleton with K trees.

    Parameters
    ----------
    keypoints : ndarray, (n, J, 2)
        Metres, x right, y up. Hidden joints are set to 0 and never read.
    visible : ndarray, (n, J), bool
        Which joints are annotated; at least one of each character.
    skeleton : Skeleton
        Names and parents of the J joints.
    neighbours : ndarray, (n, 2, J, 2)
        The same joints in the frame before and in the frame after, in the annotation's own video
        and axes. NaN where there is none: at a cut, at an end, where hidden.
    fps : float
        Frames per second of the videos.
    views : ndarray, (n, 2), optional
        The views (φ, θ), radians, NaN for annotations whose view is unknown. By default they are
        to be estimated, see :func:`~probmotion.interaction.annotations.backbones.annotation_views`.
    sources : sequence of str, optional
        Name of the video of each annotation.
    dropped : mapping of str to int
        What a loader left out: how many frames, by reason.

    Raises
    ------
    ValueError
        If there is no annotation, shapes do not fit, a visible joint is not finite, or an
        annotation shows no joint of a character; the message names the first one.
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
            raise ValueError("keypoints has no annotation, expected at least one")
        visible = np.asarray(self.visible)
        check_shape("visible", visible, keypoints.shape[:2])
        if visible.dtype != np.bool_:
            raise ValueError(f"visible is of {visible.dtype}, expected bool")
        missing = ~np.isfinite(keypoints).all(axis=-1) & visible
        if missing.any():
            index, joint = np.argwhere(missing)[0]
            raise ValueError(
                f"keypoints is not finite in annotation {index}, joint "
                f"{self.skeleton.joint_names[joint]}, expected it hidden there"
            )
        self._refuse_missing_characters(visible)
        neighbours = np.asarray(self.neighbours, dtype=np.float64)
        check_shape("neighbours", neighbours, (n, 2, self.skeleton.n_joints, 2))
        if np.isinf(neighbours).any():
            raise ValueError("neighbours has infinite values, expected numbers, or NaN where none")
        check_positive("fps", self.fps)
        if self.views is not None:
            views = np.asarray(self.views, dtype=np.float64)
            check_shape("views", views, (n, 2))
            if np.isinf(views).any():
                raise ValueError("views has infinite values, expected numbers, or NaN if unknown")
            object.__setattr__(self, "views", views)
        if self.sources is not None:
            sources = tuple(str(source) for source in self.sources)
            if len(sources) != n:
                raise ValueError(f"sources has {len(sources)} names, expected {n}")
            object.__setattr__(self, "sources", sources)
        object.__setattr__(self, "keypoints", np.where(visible[..., np.newaxis], keypoints, 0.0))
        object.__setattr__(self, "visible", visible)
        object.__setattr__(self, "neighbours", neighbours)
        object.__setattr__(self, "fps", float(self.fps))
        object.__setattr__(self, "dropped", dict(self.dropped))

    def __len__(self) -> int:
        return len(self.keypoints)

    def subset(self, indices: Sequence[int] | np.ndarray) -> Annotations:
        """Return the annotations at ``indices``, in that order."""
        chosen = np.asarray(indices)
        if chosen.dtype == np.bool_:
            check_shape("indices", chosen, (len(self),))
            chosen = np.flatnonzero(chosen)
        elif chosen.size and not np.issubdtype(chosen.dtype, np.integer):
            raise ValueError(f"indices is of {chosen.dtype}, expected integers or a mask")
        if chosen.size and (chosen.min() < 0 or chosen.max() >= len(self)):
            raise ValueError(
                f"indices has values from {chosen.min()} to {chosen.max()}, expected them from 0 "
                f"to {len(self) - 1}"
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
        """Return the annotations of several videos as one set.

        Views are kept where all have them, names of videos where any has them.

        Raises
        ------
        ValueError
            If there is none, or they differ in skeleton or frame rate.
        """
        if not several:
            raise ValueError("several must contain at least one set of annotations, got none")
        first = several[0]
        for number, other in enumerate(several):
            if other.skeleton != first.skeleton or other.fps != first.fps:
                raise ValueError(
                    f"several[{number}] has {other.skeleton.n_joints} joints at {other.fps:g} "
                    f"frames per second, expected the first one's {first.skeleton.n_joints} at "
                    f"{first.fps:g}"
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
            sources=[name for some in names for name in some] if any(map(any, names)) else None,
            dropped={r: sum(other.dropped.get(r, 0) for other in several) for r in reasons},
        )

    def describe(self) -> str:
        """Return one sentence: how many annotations, hidden joints and left-out frames."""
        hidden = int((~self.visible).sum())
        text = f"{len(self)} annotations"
        text += f", {hidden} of {self.visible.size} joints hidden" if hidden else ""
        left_out = [f"{count} ({why})" for why, count in self.dropped.items() if count]
        return text + (f", frames dropped: {', '.join(left_out)}" if left_out else "")

    def local_differences(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how much what each joint moves in the image changes per frame (eq. 12's Δp).

        Returns
        -------
        turn : ndarray, (n, J)
            Length of the change of the bone's direction, the unit vector from the parent to the
            joint; at a root, of the direction from the root to its tree's chest.
        stretch : ndarray, (n, J)
            Change of the bone's length, metres; at a root, how far it moves.

        Notes
        -----
        Per frame: half the central difference where both neighbours exist, else the one-sided one,
        0 where there is none. A bone of length 0 has direction 0.
        """
        own = np.where(self.visible[..., np.newaxis], self.keypoints, np.nan)
        times = np.stack([self.neighbours[:, 0], own, self.neighbours[:, 1]])
        base, tip = self._bones()
        bones = times[:, :, tip] - times[:, :, base]
        lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
        turn = _change(bones / np.where(lengths > 0, lengths, 1.0))
        stretch = _change(lengths)
        roots = list(self.skeleton.roots)
        stretch[:, roots] = _change(times[:, :, roots])
        return turn, stretch

    def save(self, path: str | Path) -> None:
        """Write the annotations to an ``.npz`` archive, whole or not at all."""
        arrays: dict[str, np.ndarray] = {
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
        """Read what :meth:`save` wrote.

        Raises
        ------
        ValueError
            If the file is no such archive, or is damaged.
        FileNotFoundError
            If there is no such file.
        """
        from probmotion.io.errors import read_bytes

        content = read_bytes(Path(path))
        try:
            with np.load(io.BytesIO(content)) as archive:
                held = dict(archive)
            skeleton = Skeleton(
                held["joint_names"].tolist(),
                held["parents"].tolist(),
                held["radii"].tolist() if "radii" in held else None,
            )
            counts = held["dropped_counts"].tolist()
            return cls(
                held["keypoints"],
                held["visible"],
                skeleton,
                held["neighbours"],
                held["fps"].item(),
                views=held.get("views"),
                sources=held["sources"].tolist() if "sources" in held else None,
                dropped=dict(zip(held["dropped_reasons"].tolist(), counts, strict=True)),
            )
        except (ValueError, KeyError, OSError, EOFError, AttributeError, zipfile.BadZipFile) as why:
            raise ValueError(
                f"{path} holds no annotations ({str(why)[:120]}), expected an archive that "
                "Annotations.save wrote"
            ) from why

    def _bones(self) -> tuple[list[int], list[int]]:
        """Return where each joint's bone begins and ends; a root's goes up to its chest."""
        base, tip = list(self.skeleton.parents), list(range(self.skeleton.n_joints))
        for root, chest in zip(self.skeleton.roots, chests(self.skeleton), strict=True):
            base[root], tip[root] = root, chest
        return base, tip

    def _refuse_missing_characters(self, visible: np.ndarray) -> None:
        for root in self.skeleton.roots:
            unseen = ~visible[:, np.equal(trees(self.skeleton), root)].any(axis=-1)
            if unseen.any():
                raise ValueError(
                    f"visible shows no joint of the character of "
                    f"{self.skeleton.joint_names[root]} in annotation "
                    f"{int(np.argmax(unseen))} (one person missing), expected at least one"
                )


def _change(values: np.ndarray) -> np.ndarray:
    """Return the length of the change per frame of (before, own, after), ``(3, …, d) → (…)``."""
    before, own, after = values
    central, first, last = (
        np.linalg.norm(change, axis=-1)
        for change in ((after - before) / 2, own - before, after - own)
    )
    # A difference is NaN where one of its two frames is missing.
    known = np.where(np.isnan(central), np.where(np.isnan(first), last, first), central)
    return np.nan_to_num(known, nan=0.0)

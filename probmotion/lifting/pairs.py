"""Lifting of two people in one video, with a prior learnt from the video's own keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from probmotion import seeds
from probmotion.data.pair_sets import choose_seed
from probmotion.data.pairs import pair_of
from probmotion.files import written_together, written_whole
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.tracks import (
    annotations_of_keypoints,
    keypoints_of_tracks,
    running_median,
)
from probmotion.io.files import save
from probmotion.io.npz import write_npz
from probmotion.lifting.pair_page import pair_page
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.pair_posterior import PairSettings
from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
from probmotion.models.unseen_depth.smoothing import smoothed_lifts
from probmotion.models.unseen_depth.view_cells import OneDirectionError
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count

__all__ = ["LiftedPairs", "lift_pairs"]

_PAIR = Skeleton.preset("pair17")
_APART = 0.2  # between annotations from which the prior is learnt, seconds
_LEAST_SECONDS = 10.0  # of frames that show both people
_CONFIDENT = 0.3  # least confidence of a keypoint that is used
_NEIGHBOURS = 0.08  # half the length of the medians that tell outliers, seconds
_FAR = 0.15  # distance of an outlier from the median, metres
_LONGEST_GAP = 0.2  # of missing keypoints that are interpolated, seconds
_DOUBTFUL = 0.1  # nats a frame by which the other order of the people is more probable


@dataclass(frozen=True, eq=False)
class LiftedPairs:
    """Posterior of the motion of two people given the keypoints of one still camera.

    Axes are the camera's: x right, y up, z towards the camera, whose distance is not estimated: the
    mean depth of the joints is 0 in every frame. The lowest joint is near y = 0.

    Parameters
    ----------
    mean : Motion
        Posterior mean on ``pair17``.
    sd : ndarray, (L, J, 3)
        Posterior standard deviations, metres.
    draws : ndarray, (n, L, J, 3)
        Posterior draws, metres.
    keypoints : ndarray, (L, J, 2)
        Keypoints that were used, in the same axes, metres; NaN where missing.
    outliers : float
        Share of keypoints that were left out, since they are far from those before and after.
    annotations : Annotations
        Annotations of the frames that show both people.
    prior : AnnotationPrior
        Prior learnt from five of them a second.
    other_order : float
        Mean log density of an annotation with the people exchanged, relative to the order used,
        nats; −inf if the prior cannot be learnt in that order.
    """

    mean: Motion
    sd: np.ndarray
    draws: np.ndarray
    keypoints: np.ndarray
    outliers: float
    annotations: Annotations
    prior: AnnotationPrior
    other_order: float

    @property
    def valid_seeds(self) -> np.ndarray:
        """Mask (L,) of the frames whose mean can be the seed of a pose-pair posterior."""
        valid = JointLimits.shipped().on(_PAIR).is_valid(self.mean.positions)
        mask: np.ndarray = (~valid).sum(axis=-1) <= PairSettings().max_invalid
        return mask

    def summary(self) -> list[str]:
        """Return sentences on the annotations, the precision and the order of the people."""
        depth = 1000 * np.median(self.sd[..., 2])
        image = 1000 * np.median(self.sd[..., :2])
        learnt = len(_learnt_from(self.annotations, self.mean.fps))
        sentences = [
            f"The prior is learnt from this video alone, from {learnt} of its {self.mean.frames} "
            f"frames. Frames with both people: {self.annotations.describe()}; "
            f"{100 * self.outliers:.1f} % of the keypoints were outliers and left out.",
            f"Joints have a standard deviation of {depth:.0f} mm in depth and {image:.0f} mm along "
            "the image's axes (median).",
        ]
        if self.other_order > _DOUBTFUL:
            sentences.append(
                "The keypoints are more probable if the first person is the second of the seed "
                f"(by {self.other_order:.2f} nats a frame): compare with --swap-people."
            )
        return sentences

    def save(self, folder: str | Path) -> None:
        """Write the motion, the page, and what sampling needs to start from one of its poses.

        The files are ``pairs.html``, ``pairs.bvh`` and ``pairs.glb`` (the mean with rigid bones),
        ``pairs.npz`` (mean, standard deviations and draws), ``annotations.npz`` and ``prior.npz``.
        """
        folder = Path(folder)
        with written_together(folder) as unfinished:
            write_npz(self.mean, unfinished / "pairs.npz", {"sd": self.sd, "draws": self.draws})
            self.annotations.save(unfinished / "annotations.npz")
            self.prior.save(unfinished / "prior.npz")
            rigid = rigid_motion(self.mean)
            save(rigid, unfinished / "pairs.bvh")
            save(rigid, unfinished / "pairs.glb")
            (unfinished / "pairs.html").write_text(self._page(folder), encoding="utf-8")

    def report(self, path: str | Path) -> Path:
        """Write a page to browse the pairs beside the keypoints, and return its path."""
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise ValueError(f"path must end in .html, got {str(path)!r}")
        with written_whole(path) as unfinished:
            unfinished.write_text(self._page(path.parent), encoding="utf-8")
        return path

    def _page(self, folder: Path) -> str:
        """Return the page, whose command reads the files of a folder."""
        return pair_page(
            self.mean,
            self.sd,
            self.draws,
            self.keypoints,
            self.valid_seeds,
            self.summary(),
            folder,
        )


def lift_pairs(
    tracks: Sequence[KeypointTrack],
    start: Motion,
    *,
    swap_people: bool = False,
    draws: int = 30,
    seed: int = 0,
    progress: bool = True,
) -> LiftedPairs:
    """Return the posterior of the 3D motion of two people given the keypoints of a still camera.

    A Gaussian prior over pose-pairs is learnt from five frames a second of the video by EM over
    the unseen depth and the unknown view. All frames are lifted by it and smoothed over time
    (:mod:`probmotion.models.unseen_depth.smoothing`). Keypoints more than 15 cm from the
    running median are left out; gaps of up to .2 s are interpolated.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Keypoints of both people, pixels; those with a confidence below .3 are not used.
    start : Motion
        3D pose-pair of the same kind of motion, or several, of which the medoid is used: it sets
        the size of the people and resolves the reflection in depth.
    swap_people : bool
        Whether the first track is the second person of ``start``.
    draws : int
        Number of posterior draws.
    seed : int
        Seed of the draws.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If there are not two tracks with all limbs, or not two close people in ``start``, both
        people are visible for less than 10 s, a joint is never visible, or the camera sees them
        from one direction only.
    """
    check_count("draws", draws, least=2)
    check_count("seed", seed, least=0)
    if len(tracks) != 2:
        raise ValueError(
            f"tracks must be of two people, got {len(tracks)}; of more, choose two (--persons I J)"
        )
    poses = pair_of(start).positions
    pose = poses[choose_seed(poses)]
    ordered = list(tracks)[::-1] if swap_people else list(tracks)
    fps, name = tracks[0].fps, _shared_name(*tracks)
    keypoints, outliers = _repaired(
        keypoints_of_tracks(ordered, pose, least_confidence=_CONFIDENT), fps
    )
    annotations = annotations_of_keypoints(keypoints, fps, name)
    if len(annotations) < _LEAST_SECONDS * fps:
        raise ValueError(
            f"tracks must show both people for at least {_LEAST_SECONDS:g} s with a confidence of "
            f"at least {_CONFIDENT:g}, got {len(annotations) / fps:.1f} s: the prior "
            "is learnt from the video's own frames; use a longer video"
        )
    chosen = annotations.subset(_learnt_from(annotations, fps))
    unseen = np.flatnonzero(~chosen.visible.any(axis=0))
    if len(unseen):
        raise ValueError(
            "tracks must show every joint in some frames with a confidence of at least "
            f"{_CONFIDENT:g}, got none of {_PAIR.joint_names[unseen[0]]}"
        )
    try:
        prior = AnnotationPrior.fit(chosen, pose, progress=progress)
    except OneDirectionError as error:
        raise ValueError(
            "tracks must show the people from several directions, got one direction only: the "
            "depth is not identifiable; use a longer video in which they turn, or exchange them "
            "if the first track is the second person of the seed (--swap-people)"
        ) from error
    rng = seeds.generator(seed, "pairs")
    lifts = smoothed_lifts(prior, keypoints, fps, rng, draws)
    middle, floor = lifts.positions[..., 0].mean(), np.quantile(lifts.positions.min(1)[:, 1], 0.02)
    origin = np.array([middle, floor, 0.0])
    return LiftedPairs(
        Motion(lifts.positions - origin, _PAIR, fps, name=name),
        lifts.sd,
        lifts.draws - origin,
        keypoints - origin[:2],
        outliers,
        annotations,
        prior,
        _other_order(chosen, pose) - float(prior.log_evidence(chosen).mean()),
    )


def _shared_name(first: KeypointTrack, second: KeypointTrack) -> str:
    """Return the words with which both names begin: those of the video, without the person."""
    names = zip(first.name.split(" "), second.name.split(" "), strict=False)
    return " ".join(word for word, _ in takewhile(lambda pair: pair[0] == pair[1], names))


def _learnt_from(annotations: Annotations, fps: float) -> np.ndarray:
    """Return the indices of the annotations from which the prior is learnt."""
    return np.arange(0, len(annotations), max(1, round(_APART * fps)))


def _repaired(keypoints: np.ndarray, fps: float) -> tuple[np.ndarray, float]:
    """Return keypoints without outliers and short gaps, and the share of outliers."""
    median = running_median(keypoints, max(1, round(_NEIGHBOURS * fps)))
    far = np.linalg.norm(keypoints - median, axis=-1) > _FAR
    known = np.isfinite(keypoints).all(axis=-1)
    repaired = np.where((known & ~far)[..., None], keypoints, np.nan)
    frames = np.arange(len(keypoints))
    for joint in range(keypoints.shape[1]):
        seen = np.flatnonzero(np.isfinite(repaired[:, joint, 0]))
        if not len(seen):
            continue
        after = np.minimum(np.searchsorted(seen, frames), len(seen) - 1)
        before = np.maximum(np.searchsorted(seen, frames, side="right") - 1, 0)
        short = seen[after] - seen[before] <= _LONGEST_GAP * fps
        short &= (seen[before] <= frames) & (frames <= seen[after])
        for axis in range(2):
            values = np.interp(frames, seen, repaired[seen, joint, axis])
            repaired[short, joint, axis] = values[short]
    return repaired, float(far.sum() / max(known.sum(), 1))


def _other_order(annotations: Annotations, pose: np.ndarray) -> float:
    """Return the mean log density of the annotations with people exchanged."""
    order = np.roll(np.arange(_PAIR.n_joints), _PAIR.roots[1])
    exchanged = replace(
        annotations,
        keypoints=annotations.keypoints[:, order],
        visible=annotations.visible[:, order],
        neighbours=annotations.neighbours[:, :, order],
    )
    try:
        prior = AnnotationPrior.fit(exchanged, pose)
    except OneDirectionError:  # in this order only
        return -np.inf
    return float(prior.log_evidence(exchanged).mean())

"""Data sets of 2D tracks to learn from: where they come from, and which clips are kept out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from probmotion import seeds
from probmotion.data.projections import Centre, DetectorNoise, Filming, project_clips
from probmotion.data.synthetic.walks import shared_skeleton, synthetic_walks
from probmotion.data.tracks.preparation import PreparedTracks, prepare_tracks
from probmotion.data.tracks.scale_reports import per_track_scales
from probmotion.data.tracks.scales import bone_sizes, scale_to_bones
from probmotion.io.files import files_named, read_keypoints
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import Split, clip_of, split_clips, tracks_of_clips

__all__ = [
    "LearningTracks",
    "certain",
    "film_clips",
    "film_windows",
    "read_tracks",
    "split_tracks",
    "synthetic_walks",
]


@dataclass(frozen=True, eq=False)
class LearningTracks:
    """Prepared 2D tracks, apart by clip.

    Parameters
    ----------
    train, validation, test : list of KeypointTrack
        Metres, centred on the root. Weights are learnt from ``train`` alone; ``test`` is not even
        looked at.
    split : Split
        The clips' names.
    """

    train: list[KeypointTrack]
    validation: list[KeypointTrack]
    test: list[KeypointTrack]
    split: Split


def film_clips(
    motions: Sequence[Motion],
    skeleton: Skeleton,
    fps: float,
    *,
    views: int = 64,
    seed: int = 0,
    filming: Filming | None = None,
    noise: DetectorNoise | None = None,
    shortest: float = 1.0,
) -> PreparedTracks:
    """Return what cameras around 3D clips and a detector would have given, prepared.

    Parameters
    ----------
    motions : sequence of Motion
        The clips, of any skeletons that have the joints asked for.
    skeleton : Skeleton
        The joints that are detected.
    fps : float
        Frames per second of the tracks.
    views, seed, filming, noise
        See :func:`~probmotion.data.projections.project_clips`.
    shortest : float
        Seconds of the shortest track that is kept.
    """
    shot = Filming() if filming is None else filming
    clips = [motion.retarget(skeleton) for motion in motions]
    tracks = project_clips(clips, views=views, seed=seed, filming=shot, noise=noise)
    # Cameras are alone with their clip: no other track stands in the same picture.
    alone = [track.name for track in tracks]
    return prepare_tracks(tracks, fps=fps, videos=alone, centre=shot.centre, shortest=shortest)


def certain(tracks: Sequence[KeypointTrack], threshold: float = 0.3) -> list[KeypointTrack]:
    """Return tracks whose joints count whole or not at all: confidence 1 from the threshold on.

    Of filmed tracks confidences tell which joints are lost; among those that are found the made
    detector draws them at random, and to weigh errors by them would weigh by noise.
    """
    return [
        replace(track, confidence=np.where(track.confidence >= threshold, 1.0, 0.0))
        for track in tracks
    ]


def film_windows(
    motions: Sequence[Motion], skeleton: Skeleton, fps: float, frames: int, n: int, *, seed: int
) -> np.ndarray:
    """Return n random windows of filmed clips, whole: ``(n, frames, J, 2)``, metres.

    The detector errs but loses no joint, and windows with a hole are left out; all else is as in
    :func:`film_clips`. Every window of every clip is as likely, from 64 sides, and as likely in a
    mirror: what is compared with them has learnt from mirror images, too.

    Raises
    ------
    ValueError
        If no clip is as long as a window.
    """
    noise = DetectorNoise(share=0.0)
    filmed = film_clips(motions, skeleton, fps, views=64, seed=seed, noise=noise).tracks
    every = [
        sliding_window_view(track.keypoints, frames, axis=0).transpose(0, 3, 1, 2)
        for track in filmed
        if track.frames >= frames
    ]
    # Cleaning hides single entries that it takes for strays.
    whole = [windows[np.isfinite(windows).all(axis=(1, 2, 3))] for windows in every]
    if not sum(map(len, whole)):
        raise ValueError(
            f"motions has clips of at most {max(track.frames for track in filmed)} frames at "
            f"{fps:g} frames per second, expected frames={frames} without a hole in one"
        )
    found = np.concatenate(whole)
    rng = seeds.generator(seed, "windows")
    chosen = found[rng.choice(len(found), n, replace=n > len(found))]
    turned = rng.random(n) < 0.5
    flipped = chosen[turned][:, :, list(skeleton.mirrored_order)] * np.array([-1.0, 1.0])
    chosen[turned] = flipped + 0.0  # a root at -0 is one at 0
    return chosen


def read_tracks(
    paths: Iterable[str | Path],
    skeleton: Skeleton | None,
    fps: float,
    *,
    file_fps: float | None = None,
    layout: str | None = None,
    people: int | None = None,
    threshold: float = 0.3,
    centre: Centre = "frame",
    sizes: Mapping[str, float] | None = None,
    shortest: float = 1.0,
) -> PreparedTracks:
    """Return the tracks of files of 2D keypoints, prepared, in metres.

    Where no size of a bone is known (:func:`body_sizes` knows none, and ``sizes`` says none), the
    unit is the body's length instead: the median over tracks of the diagonal of the body's box is
    1 (:func:`~probmotion.data.tracks.scale_reports.per_track_scales`).

    Parameters
    ----------
    paths : iterable of str or Path
        Files, or patterns of them, each of its own name. A track is called ``"<file>/<name>"``.
    skeleton : Skeleton, optional
        The joints to bring tracks to; None: their own, which must be the same in all.
    fps : float
        Frames per second of the data set.
    file_fps : float, optional
        Frames per second of files that do not hold it.
    layout, people
        What keypoints in files are, and how many people to follow, where files do not say; see
        :func:`~probmotion.io.read_keypoints`.
    threshold : float
        Least confidence that counts.
    centre : {"frame", "sequence"}
        Where the root is at the origin.
    sizes : mapping of str to float, optional
        Bone sizes that pixels are brought to, of all bones or some; those of :func:`body_sizes` by
        default.
    shortest : float
        Seconds of the shortest track that is kept.

    Raises
    ------
    FileNotFoundError
        If a pattern matches no file.
    ValueError
        If two files have one name, which is that of their clip, no track shows a bone, or tracks
        have several skeletons and none is given to bring them to.
    """
    raw: list[KeypointTrack] = []
    videos: list[str] = []
    files: dict[str, Path] = {}
    for path in files_named(paths):
        if path.stem in files:
            raise ValueError(
                f"paths has {files[path.stem]} and {path}, expected files of other names: a clip "
                "is called as its file"
            )
        files[path.stem] = path
        archive = path.suffix.lower() == ".npz"
        held = (None, None, None) if archive else (file_fps, layout, people)
        for track in read_keypoints(path, *held):
            # A clip's name ends at the last slash, which names of images may have too.
            name = f"{path.stem}/{track.name.replace('/', '_')}"
            raw.append(replace(track, name=name))
            videos.append(name if archive else _video(path, track))
    own = raw[0].skeleton if skeleton is None and raw else skeleton
    known = sizes if sizes is not None or own is None else body_sizes(own) or None
    prepared = prepare_tracks(
        raw, fps=fps, skeleton=skeleton, sizes=known, videos=videos, threshold=threshold,
        centre=centre, shortest=shortest,
    )  # fmt: skip
    if known is not None:
        return prepared
    scaled, report = scale_to_bones(prepared.tracks, per_track_scales(prepared.tracks))
    return PreparedTracks(tuple(scaled), (*prepared.reports, report))


def _video(path: Path, track: KeypointTrack) -> str:
    """Return which pictures a track of a table or of JSON is from: people stand side by side.

    Readers call people ``"file video person"``; of several videos in a file, most differ in frames.
    """
    return f"{path} {track.name.rpartition(' ')[0]} {track.frames}"


def body_sizes(skeleton: Skeleton) -> dict[str, float]:
    """Return how long a grown body's bones are in pictures, metres, by joint.

    The statistic is :func:`~probmotion.data.tracks.scales.bone_sizes` of people, or quadrupeds, who
    are made to walk, filmed from all around without errors. Where neither has all joints, it is of
    the bones that one of them shares (:func:`~probmotion.data.synthetic.walks.shared_skeleton`):
    COCO's limbs are a person's. There is none where no bone is shared.
    """
    shared = shared_skeleton(skeleton)
    if shared is None:
        return {}
    filmed = film_clips(
        synthetic_walks(8, shared), shared, 20.0, views=16, noise=DetectorNoise.none()
    )
    return bone_sizes(filmed.tracks)


def split_tracks(
    tracks: Sequence[KeypointTrack],
    *,
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    seed: int = 0,
) -> LearningTracks:
    """Return tracks apart by clip: the clips that are named, or a tenth each at random.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared tracks.
    validation, test : sequence of str
        Names of clips; both are given, or neither.
    seed : int
        Seed of the choice where none are given.

    Raises
    ------
    ValueError
        If only one of the two is given, a clip is in both, has no track, or none is left to learn
        from.
    """
    if bool(validation) != bool(test):
        given, missing = ("validation", "test") if validation else ("test", "validation")
        raise ValueError(f"{given} is given without {missing}, expected clips for both or neither")
    clips = {clip_of(track.name) for track in tracks}
    if not validation:
        split = split_clips(clips, seed=seed)
    else:
        if twice := sorted(set(validation) & set(test)):
            raise ValueError(
                f"test has {twice[0]!r}, which validation has too, expected other clips"
            )
        rest = sorted(clips - set(validation) - set(test))
        if not rest:
            raise ValueError("validation and test have every clip, expected some to learn from")
        split = Split(tuple(rest), tuple(sorted(validation)), tuple(sorted(test)))
    return LearningTracks(
        tracks_of_clips(tracks, split.train),
        tracks_of_clips(tracks, split.validation),
        tracks_of_clips(tracks, split.test),
        split,
    )

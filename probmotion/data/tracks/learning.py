"""Data sets of 2D tracks for training: projected from 3D clips or read from files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from probmotion import seeds
from probmotion.data.projections import Centre, DetectorNoise, Filming, project_clips
from probmotion.data.synthetic.walks import shared_skeleton, synthetic_walks
from probmotion.data.tracks.preparation import PreparedTracks, prepare_tracks
from probmotion.data.tracks.scales import bone_sizes, per_track_scales, scale_to_bones
from probmotion.io.files import files_named
from probmotion.io.keypoints.files import read_keypoints
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import Split, clip_of, split_clips, tracks_of_clips

__all__ = [
    "LearningTracks",
    "body_sizes",
    "certain",
    "film_clips",
    "film_windows",
    "read_tracks",
    "split_names",
    "split_tracks",
    "unique_files",
]


@dataclass(frozen=True, eq=False)
class LearningTracks:
    """Prepared 2D tracks, centred on the root and split by clip."""

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
    """Return prepared 2D tracks of 3D clips, seen by random cameras with detector noise.

    Parameters
    ----------
    motions : sequence of Motion
        Clips; each skeleton must contain the joints of ``skeleton``.
    skeleton : Skeleton
        Detected joints.
    fps : float
        Frames per second of the tracks.
    views, seed, filming, noise
        See :func:`~probmotion.data.projections.project_clips`.
    shortest : float
        Minimum duration of a track, seconds.
    """
    filming = filming or Filming()
    clips = [motion.retarget(skeleton) for motion in motions]
    tracks = project_clips(clips, views=views, seed=seed, filming=filming, noise=noise)
    videos = [track.name for track in tracks]  # one person each
    return prepare_tracks(tracks, fps=fps, videos=videos, centre=filming.centre, shortest=shortest)


def certain(tracks: Sequence[KeypointTrack], threshold: float = 0.3) -> list[KeypointTrack]:
    """Return tracks with confidences set to 1 at or above the threshold and to 0 below it.

    Confidences of synthetic detections only indicate missing joints and should not weight errors.
    """
    return [replace(track, confidence=1.0 * (track.confidence >= threshold)) for track in tracks]


def film_windows(
    motions: Sequence[Motion], skeleton: Skeleton, fps: float, frames: int, n: int, *, seed: int
) -> np.ndarray:
    """Return n random complete windows of projected clips, ``(n, frames, J, 2)``, metres.

    The detector is noisy but misses no joint; incomplete windows are dropped. Windows are drawn
    uniformly from 64 views of all clips and mirrored with probability 1/2, as in training.

    Raises
    ------
    ValueError
        If no clip contains a complete window.
    """
    noise = DetectorNoise(share=0.0)
    filmed = film_clips(motions, skeleton, fps, views=64, seed=seed, noise=noise).tracks
    windows_of_tracks = [
        sliding_window_view(track.keypoints, frames, axis=0).transpose(0, 3, 1, 2)
        for track in filmed
        if track.frames >= frames
    ]
    # The outlier filter may have removed single detections.
    complete = [part[np.isfinite(part).all(axis=(1, 2, 3))] for part in windows_of_tracks]
    if not sum(map(len, complete)):
        raise ValueError(
            f"motions must contain a complete window of {frames} frames at {fps:g} fps, got tracks "
            f"of at most {max(track.frames for track in filmed)} frames"
        )
    windows = np.concatenate(complete)
    rng = seeds.generator(seed, "windows")
    chosen = windows[rng.choice(len(windows), n, replace=n > len(windows))]
    mirrored = rng.random(n) < 0.5
    flipped = chosen[mirrored][:, :, list(skeleton.mirrored_order)] * np.array([-1.0, 1.0])
    chosen[mirrored] = flipped + 0.0  # no -0
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
    """Read and prepare 2D tracks from files of keypoints, in metres or body lengths.

    Without known bone sizes (neither ``sizes`` nor :func:`body_sizes`) the unit is the body length:
    the median :func:`~probmotion.data.tracks.scales.body_extent` of the tracks is 1
    (:func:`~probmotion.data.tracks.scales.per_track_scales`).

    Parameters
    ----------
    paths : iterable of str or Path
        Files with unique names, or patterns. A track is named ``"<file>/<name>"``.
    skeleton : Skeleton, optional
        Target skeleton; if None, the skeleton of the tracks, which must be the same for all.
    fps : float
        Frames per second of the data set.
    file_fps : float, optional
        Frames per second of files that do not contain it.
    layout, people
        Keypoint layout and number of people, for files that do not contain them; see
        :func:`~probmotion.io.keypoints.read_keypoints`.
    threshold : float
        Minimum confidence of a detection.
    centre : {"frame", "sequence"}
        Whether the root is at the origin in every frame or on average.
    sizes : mapping of str to float, optional
        Bone sizes to scale to, metres, for all or some bones; :func:`body_sizes` by default.
    shortest : float
        Minimum duration of a track, seconds.

    Raises
    ------
    FileNotFoundError
        If a pattern matches no file.
    ValueError
        If file names repeat, no track shows a bone, or tracks have several skeletons and
        ``skeleton`` is None.
    """
    raw: list[KeypointTrack] = []
    videos: list[str] = []
    for path in unique_files(paths).values():
        archive = path.suffix.lower() == ".npz"
        options = (None, None, None) if archive else (file_fps, layout, people)
        for track in read_keypoints(path, *options):
            # The clip's name ends at the last slash, so slashes in the track's name are replaced.
            name = f"{path.stem}/{track.name.replace('/', '_')}"
            raw.append(replace(track, name=name))
            # Track names are "video person"; without the person they identify the video.
            video = f"{path} {track.name.rpartition(' ')[0]} {track.frames}"
            videos.append(name if archive else video)
    target = raw[0].skeleton if skeleton is None and raw else skeleton
    known = sizes if sizes is not None or target is None else body_sizes(target) or None
    prepared = prepare_tracks(
        raw, fps=fps, skeleton=skeleton, sizes=known, videos=videos, threshold=threshold,
        centre=centre, shortest=shortest,
    )  # fmt: skip
    if known is not None:
        return prepared
    scaled, report = scale_to_bones(prepared.tracks, per_track_scales(prepared.tracks))
    return PreparedTracks(tuple(scaled), (*prepared.reports, report))


def unique_files(paths: Iterable[str | Path]) -> dict[str, Path]:
    """Return a mapping from stems, the clip names, to the files matching paths or patterns."""
    files: dict[str, Path] = {}
    for path in files_named(paths):
        if path.stem in files:
            raise ValueError(f"files must have unique names, got {files[path.stem]} and {path}")
        files[path.stem] = path
    return files


def body_sizes(skeleton: Skeleton) -> dict[str, float]:
    """Return the apparent bone sizes of an adult body, metres, by joint.

    The sizes are the :func:`~probmotion.data.tracks.scales.bone_sizes` of projected synthetic walks
    for the bones shared with a person or a quadruped. If no bone is shared
    (:func:`~probmotion.data.synthetic.walks.shared_skeleton`), the mapping is empty.
    """
    return dict(_body_sizes(skeleton))


@cache
def _body_sizes(skeleton: Skeleton) -> dict[str, float]:
    shared = shared_skeleton(skeleton)
    if shared is None:
        return {}
    walks, noise = synthetic_walks(8, shared), DetectorNoise.none()
    return bone_sizes(film_clips(walks, shared, 20.0, views=16, noise=noise).tracks)


def split_tracks(
    tracks: Sequence[KeypointTrack],
    *,
    validation: Sequence[str] = (),
    test: Sequence[str] = (),
    seed: int = 0,
) -> LearningTracks:
    """Split tracks by clip into training, validation and test tracks.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared tracks.
    validation, test : sequence of str
        Names of clips, for both parts or neither; by default a random tenth of the clips each.
    seed : int
        Seed of the random split.

    Raises
    ------
    ValueError
        If only ``validation`` or only ``test`` is given, a clip is in both or has no track, or no
        clip remains for training.
    """
    clips = {clip_of(track.name) for track in tracks}
    split = split_names(clips, validation=validation, test=test, seed=seed)
    train_tracks, validation_tracks, test_tracks = (
        tracks_of_clips(tracks, part) for part in (split.train, split.validation, split.test)
    )
    return LearningTracks(train_tracks, validation_tracks, test_tracks, split)


def split_names(
    clips: Iterable[str], *, validation: Sequence[str], test: Sequence[str], seed: int
) -> Split:
    """Split the names of clips as in :func:`split_tracks`."""
    names = set(clips)
    if bool(validation) != bool(test):
        given, missing = ("validation", "test") if validation else ("test", "validation")
        raise ValueError(f"{given} requires {missing}; name clips for both or neither")
    if not validation:
        return split_clips(names, seed=seed)
    for part, chosen in (("validation", validation), ("test", test)):
        if unknown := sorted(set(chosen) - names):
            known = ", ".join(sorted(names))
            raise ValueError(f"{part} must name clips among {known}, got {unknown[0]!r}")
    if repeated := sorted(set(validation) & set(test)):
        raise ValueError(f"validation and test must be disjoint, got {repeated[0]!r} in both")
    train = sorted(names - set(validation) - set(test))
    if not train:
        raise ValueError("validation and test must exclude at least one clip for training, got all")
    return Split(tuple(train), tuple(sorted(validation)), tuple(sorted(test)))

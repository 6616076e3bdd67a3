"""Options that select the 2D tracks to train on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from probmotion.cli.training_options import check_enough_clips, listed_clips

if TYPE_CHECKING:
    from probmotion.data.tracks.learning import LearningTracks

__all__ = ["TrackData", "learning_tracks"]


@dataclass(frozen=True)
class TrackData:
    """Training data: 2D tracks, or projected 3D clips; synthetic walks by default."""

    clips: tuple[str, ...] = ()
    """3D motion files (.npz, .bvh) or quoted patterns, projected to 2D with detection errors."""

    tracks: tuple[str, ...] = ()
    """2D keypoint files (.json, .npz, .csv), OpenPose folders, or quoted patterns.
    Set --skeleton for bodies other than people."""

    tracks_fps: float | None = None
    """Frame rate of keypoint files without one, frames per second."""

    layout: str | None = None
    """Keypoint layout of JSON files (see probmotion list), if the keypoint count is ambiguous."""

    people: int | None = None
    """Number of people to track in JSON files without identities."""

    skeleton: str = "person14"
    """Skeleton (see probmotion list); own uses the joints of the track files."""

    fps: float = 20.0
    """Training frame rate, frames per second."""

    validation: tuple[str, ...] = ()
    """Names of validation clips (files without extension); a random tenth by default."""

    test: tuple[str, ...] = ()
    """Names of held-out test clips; a random tenth by default."""

    views: int | None = None
    """Number of cameras around each 3D clip; 64 by default."""

    centre: Literal["frame", "sequence"] = "frame"
    """Centre the root in every frame, or its mean over the sequence."""

    data_seed: int = 0
    """Seed of cameras, detection errors and the random split."""


def learning_tracks(
    data: TrackData, threshold: float = 0.3, shortest: float = 1.0
) -> LearningTracks:
    """Prepare and split the selected tracks, and print a summary.

    ``threshold`` is the minimum confidence of a detection, ``shortest`` the minimum duration of a
    track in seconds.
    """
    from probmotion.data.projections import Filming
    from probmotion.data.synthetic.walks import synthetic_walks
    from probmotion.data.tracks.learning import film_clips, read_tracks, split_tracks
    from probmotion.io.files import files_named, load
    from probmotion.motion.skeleton import Skeleton
    from probmotion.motion.splits import clip_of

    if data.clips and data.tracks:
        raise ValueError("clips and tracks are mutually exclusive")
    for name in ("tracks_fps", "layout", "people"):
        if getattr(data, name) is not None and not data.tracks:
            raise ValueError(f"{name} requires --tracks FILE…")
    if data.tracks and data.views is not None:
        raise ValueError("views applies to 3D clips only, got tracks")
    own_skeleton = data.skeleton == "own"
    if own_skeleton and not data.tracks:
        raise ValueError("skeleton 'own' requires --tracks FILE…")
    skeleton = None if own_skeleton else Skeleton.preset(data.skeleton)
    if skeleton is None or data.tracks:
        prepared = read_tracks(
            data.tracks,
            skeleton,
            data.fps,
            file_fps=data.tracks_fps,
            layout=data.layout,
            people=data.people,
            threshold=threshold,
            centre=data.centre,
            shortest=shortest,
        )
    else:
        # Clips are named after their files, not by the names stored inside.
        clips = [replace(load(path), name=path.stem) for path in files_named(data.clips)]
        prepared = film_clips(
            clips or synthetic_walks(skeleton=skeleton),
            skeleton,
            data.fps,
            views=64 if data.views is None else data.views,
            seed=data.data_seed,
            filming=Filming(centre=data.centre),
            shortest=shortest,
        )
    print(prepared)
    if not (data.validation or data.test):
        check_enough_clips(clip_of(track.name) for track in prepared.tracks)
    split = split_tracks(
        prepared.tracks, validation=data.validation, test=data.test, seed=data.data_seed
    )
    for part in ("train", "validation", "test"):
        names = getattr(split.split, part)
        print(f"{part}: {len(getattr(split, part))} tracks of {listed_clips(names)}")
    return split

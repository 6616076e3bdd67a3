"""Which 2D tracks a command of training learns from: its options, and the tracks they name."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from probmotion.cli.training_options import check_enough_clips, listed

if TYPE_CHECKING:
    from probmotion.data.tracks.learning import LearningTracks

__all__ = ["TrackData", "learning_tracks"]


@dataclass(frozen=True)
class TrackData:
    """What is learnt from: clips that are filmed, or tracks; people made to walk by default."""

    clips: tuple[str, ...] = ()
    """3D motion files, .npz or .bvh, or quoted patterns. They are filmed by cameras around them,
    and a detector with errors finds the joints: only these pictures are learnt from."""

    tracks: tuple[str, ...] = ()
    """Files of 2D keypoints (.json, .npz, .csv), folders of a video's frames as OpenPose writes
    them (--tracks op/video0 op/video1), or quoted patterns. Their names are those of clips. Of
    other bodies than people, --skeleton must be named."""

    tracks_fps: float | None = None
    """Frames per second of keypoints in files that do not hold it."""

    layout: str | None = None
    """What keypoints in JSON are (see probmotion list), where their number does not tell."""

    people: int | None = None
    """How many people to follow in JSON that does not say who is who."""

    skeleton: str = "person14"
    """The joints to learn (see probmotion list), which clips or tracks must have; own: those that
    the files of tracks hold."""

    fps: float = 20.0
    """Frames per second to learn at."""

    validation: tuple[str, ...] = ()
    """Names of clips (files without ending) on which the loss is watched; a tenth by default."""

    test: tuple[str, ...] = ()
    """Names of clips that are kept for measuring; a tenth by default."""

    views: int | None = None
    """Cameras around each 3D clip; 64 by default."""

    centre: Literal["frame", "sequence"] = "frame"
    """Whether the root is at the origin in every frame, or on average."""

    data_seed: int = 0
    """Seed of cameras, detection errors and, where no clips are named, of the split."""


def learning_tracks(
    data: TrackData, threshold: float = 0.3, shortest: float = 1.0
) -> LearningTracks:
    """Return the tracks that the options name, and print what preparing them dropped.

    Parameters
    ----------
    data : TrackData
        The options.
    threshold : float
        Least confidence that counts.
    shortest : float
        Seconds of the shortest track that is kept.
    """
    from probmotion.data.projections import Filming
    from probmotion.data.synthetic.walks import synthetic_walks
    from probmotion.data.tracks.learning import film_clips, read_tracks, split_tracks
    from probmotion.io.files import files_named, load_motion
    from probmotion.motion.skeleton import Skeleton
    from probmotion.motion.splits import clip_of

    if data.clips and data.tracks:
        raise ValueError("clips and tracks are both given, expected one of them")
    for name in ("tracks_fps", "layout", "people"):
        if getattr(data, name) is not None and not data.tracks:
            raise ValueError(f"{name} is given without tracks, expected --tracks FILE… beside it")
    if data.tracks and data.views is not None:
        raise ValueError("views is given with tracks, expected it only where clips are filmed")
    own = data.skeleton == "own"
    if own and not data.tracks:
        raise ValueError("skeleton is 'own' without tracks, expected --tracks FILE… that hold one")
    skeleton = None if own else Skeleton.preset(data.skeleton)
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
        # A file may hold another name; options name clips by their files.
        clips = [replace(load_motion(path), name=path.stem) for path in files_named(data.clips)]
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
    found = split_tracks(
        prepared.tracks, validation=data.validation, test=data.test, seed=data.data_seed
    )
    for part in ("train", "validation", "test"):
        names = getattr(found.split, part)
        count = len(getattr(found, part))
        print(f"{part}: {count} tracks of {len(names)} clips: {listed(names)}")
    return found

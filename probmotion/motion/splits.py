"""Clips for training, validation and test: by clip, never by window or view, under a seed.

The released code of MAS takes the first tenth of an unsorted listing as its test set; here names
are sorted first, so that neither the order of a listing nor a file system's can change a split.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from probmotion import seeds
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_positive

__all__ = ["Split", "clip_of", "name_within_clip", "split_clips", "tracks_of_clips"]


@dataclass(frozen=True)
class Split:
    """Names of the clips of each part, sorted; no clip is in two."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


def clip_of(name: str) -> str:
    """Return the clip of a track: what stands before the last ``/`` of its name, or all of it."""
    return name.rpartition("/")[0] or name


def name_within_clip(name: str, word: str) -> str:
    """Return the name of what was made of a track, such that it belongs to the same clip.

    ``"walk/left"`` gives ``"walk/left word"`` and ``"walk"`` gives ``"walk/word"``.
    """
    return f"{name} {word}" if clip_of(name) != name else f"{name}/{word}"


def split_clips(
    names: Iterable[str], *, validation: float = 0.1, test: float = 0.1, seed: int
) -> Split:
    """Split clips at random.

    Parameters
    ----------
    names : iterable of str
        Names of clips, or of tracks, whose clips are taken (:func:`clip_of`). Order and repeats
        do not matter.
    validation, test : float
        Shares of the clips, rounded to whole clips, above 0 and together below 1.
    seed : int
        Seed of the choice.

    Returns
    -------
    split : Split
        Every part has at least one clip.

    Raises
    ------
    ValueError
        If a share is out of range, or so small or large that a part would be empty.
    """
    check_positive("validation", validation)
    check_positive("test", test)
    if validation + test >= 1:
        raise ValueError(
            f"validation and test are {validation:g} and {test:g}, expected a sum below 1"
        )
    if isinstance(names, str):
        raise ValueError(f"names must be several names, got {names!r}")
    clips = sorted({clip_of(name) for name in names})
    held, tried = round(validation * len(clips)), round(test * len(clips))
    counts = (len(clips) - held - tried, held, tried)
    if min(counts) < 1:
        raise ValueError(
            f"names has {len(clips)} clips, of which train, validation and test would get "
            f"{counts[0]}, {counts[1]} and {counts[2]}; expected at least one each"
        )
    order = seeds.generator(seed, "split").permutation(len(clips))
    shuffled = [clips[place] for place in order]
    return Split(
        train=tuple(sorted(shuffled[held + tried :])),
        validation=tuple(sorted(shuffled[tried : held + tried])),
        test=tuple(sorted(shuffled[:tried])),
    )


def tracks_of_clips(tracks: Sequence[KeypointTrack], clips: Iterable[str]) -> list[KeypointTrack]:
    """Return the tracks whose clip is one of ``clips``, in their order.

    Raises
    ------
    ValueError
        If a clip has no track; the message names it. (A split is made from the tracks there are.)
    """
    wanted = set(clips)
    missing = sorted(wanted - {clip_of(track.name) for track in tracks})
    if missing:
        raise ValueError(
            f"clips has {missing[0]!r}, which names no clip of the {len(tracks)} tracks, expected "
            "only clips that have tracks, of those that preparation has kept"
        )
    return [track for track in tracks if clip_of(track.name) in wanted]

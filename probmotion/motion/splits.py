"""Random splits of clips into training, validation and test sets.

Clips are never divided, so that all windows and views of a clip are in the same set. Names are
sorted first, so that a split does not depend on the order of a file listing.
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
    """Sorted clip names of disjoint training, validation and test sets."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


def clip_of(name: str) -> str:
    """Return the clip name of a track: the part before the last ``/``, else the full name."""
    return name.rpartition("/")[0] or name


def name_within_clip(name: str, word: str) -> str:
    """Return a track name derived from ``name`` and ``word``, within the same clip.

    ``"walk/left"`` becomes ``"walk/left word"`` and ``"walk"`` becomes ``"walk/word"``.
    """
    return f"{name} {word}" if clip_of(name) != name else f"{name}/{word}"


def split_clips(
    names: Iterable[str], *, validation: float = 0.1, test: float = 0.1, seed: int
) -> Split:
    """Split clips at random into training, validation and test sets.

    Parameters
    ----------
    names : iterable of str
        Names of clips or tracks (see :func:`clip_of`). Order and duplicates are ignored.
    validation, test : float
        Fractions of clips in each set, above 0, with a sum below 1. Counts are rounded.
    seed : int
        Seed of the split.

    Returns
    -------
    split : Split
        Training, validation and test sets, each with at least one clip.

    Raises
    ------
    ValueError
        If a fraction is out of range, or a set would be empty.
    """
    check_positive("validation", validation)
    check_positive("test", test)
    if validation + test >= 1:
        raise ValueError(f"validation + test must be below 1, got {validation:g} + {test:g}")
    if isinstance(names, str):
        raise ValueError(f"names must be a sequence of names, got {names!r}")
    clips = sorted({clip_of(name) for name in names})
    n_validation, n_test = round(validation * len(clips)), round(test * len(clips))
    counts = (len(clips) - n_validation - n_test, n_validation, n_test)
    if min(counts) < 1:
        raise ValueError(
            "names must have at least one clip for each of train, validation and test, got "
            f"{counts[0]}, {counts[1]} and {counts[2]} from {len(clips)}"
        )
    order = seeds.generator(seed, "split").permutation(len(clips))
    shuffled = [clips[index] for index in order]
    return Split(
        train=tuple(sorted(shuffled[n_validation + n_test :])),
        validation=tuple(sorted(shuffled[n_test : n_validation + n_test])),
        test=tuple(sorted(shuffled[:n_test])),
    )


def tracks_of_clips(tracks: Sequence[KeypointTrack], clips: Iterable[str]) -> list[KeypointTrack]:
    """Return the tracks of the given clips, in the order of ``tracks``.

    Raises
    ------
    ValueError
        If a clip has no track.
    """
    wanted = set(clips)
    missing = sorted(wanted - {clip_of(track.name) for track in tracks})
    if missing:
        raise ValueError(
            f"clips must each have at least one of the {len(tracks)} tracks, got none for "
            f"{missing[0]!r}"
        )
    return [track for track in tracks if clip_of(track.name) in wanted]

"""The command ``probmotion pairs``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

if TYPE_CHECKING:
    from probmotion.motion.motion import KeypointTrack

__all__ = ["Pairs"]


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Lift two people who interact, from a video's 2D keypoints and one 3D pose-pair.

    Writes to --out: pairs.html (the pairs beside the keypoints, to browse and to start sampling
    from), pairs.bvh and pairs.glb (for Blender), pairs.npz (mean, standard deviations and draws),
    annotations.npz and prior.npz (the annotations of the video, and the prior learnt from them).
    """

    keypoints: Positional[Path]
    """Keypoints of two people before a still camera, for at least 10 s: file or folder of a
    detector (see probmotion show)."""

    seed: tuple[Path, ...]
    """3D pose-pair of the same kind of motion: file of two people (.bvh, .npz), or one of each
    (.bvh, .npz, .amc). Of several frames, the medoid is used."""

    out: Path
    """Output folder."""

    fps: float | None = None
    """Frame rate, frames per second; the file's by default."""

    skeleton: str | None = None
    """Layout of the keypoints; recognised by default."""

    people: int | None = None
    """Number of people to track, in files without track ids."""

    persons: Annotated[tuple[int, int] | None, arg(metavar="I J", help_behavior_hint="")] = None
    """Indices of the two people, in files of more."""

    image_size: Annotated[
        tuple[float, float] | None, arg(metavar="WIDTH HEIGHT", help_behavior_hint="")
    ] = None
    """Size of the video in pixels, for normalised landmarks of MediaPipe."""

    swap_people: FlagCreatePairsOff[bool] = False
    """The first person of the keypoints is the second one of the seed."""

    draws: int = 30
    """Number of posterior draws."""

    def run(self) -> None:
        from probmotion.data.pairs import pair_motion
        from probmotion.files import check_writable
        from probmotion.io.files import load
        from probmotion.lifting.pairs import lift_pairs

        if len(self.seed) not in (1, 2):
            raise ValueError(f"--seed must be one or two files, got {len(self.seed)}")
        motions = [load(path) for path in self.seed]
        start = motions[0] if len(motions) == 1 else pair_motion(motions[0], motions[1])
        tracks = self._tracks()
        check_writable(self.out)
        result = lift_pairs(tracks, start, swap_people=self.swap_people, draws=self.draws)
        result.save(self.out)
        print("\n".join(result.summary()))
        print(
            f"wrote {self.out / 'pairs.html'}, pairs.bvh, pairs.glb, pairs.npz, annotations.npz, "
            "prior.npz"
        )

    def _tracks(self) -> list[KeypointTrack]:
        """Return the tracks of the people chosen."""
        from probmotion.io.keypoints.files import read_keypoints

        tracks = read_keypoints(
            self.keypoints, self.fps, self.skeleton, self.people, self.image_size
        )
        if self.persons is None:
            return tracks
        if len(set(self.persons)) != 2 or not set(self.persons) <= set(range(len(tracks))):
            raise ValueError(
                f"persons must be two indices of 0 to {len(tracks) - 1}, got "
                f"{self.persons[0]} and {self.persons[1]}"
            )
        return [tracks[person] for person in self.persons]

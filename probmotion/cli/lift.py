"""The command ``probmotion lift``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

__all__ = ["Lift"]


@dataclass(frozen=True, kw_only=True)
class Lift:
    """Lift a video's 2D keypoints to 3D motion with its uncertainty.

    Writes to --out: lift.html (the motion in a browser), lift.bvh and lift.glb (for Blender),
    lift.npz (mean, standard deviations and draws) and summary.json. With several people each has a
    folder of its own.
    """

    keypoints: Positional[Path]
    """Keypoints of one still camera: file or folder of a detector (see probmotion show)."""

    out: Path
    """Output folder."""

    image_size: Annotated[tuple[int, int], arg(metavar="WIDTH HEIGHT")]
    """Size of the video, pixels."""

    fps: float | None = None
    """Frame rate, frames per second; the file's by default."""

    skeleton: str | None = None
    """Layout of the keypoints; recognised by default."""

    people: int | None = None
    """Number of people to track, in files without track ids."""

    person: int | None = None
    """Index of the person to lift; all by default."""

    fov: float = 60.0
    """Horizontal field of view, degrees. Distances from the camera depend on it."""

    pitch: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="")] = None
    """Angle of the camera above the horizon, degrees, negative if it looks down. Estimated by
    default, badly for motion unlike that of the prior."""

    height: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """Height of the person, metres; 1.7 ± .1 by default."""

    draws: int = 100
    """Number of posterior draws."""

    seed: int = 0
    """Seed of the draws."""

    strict: FlagCreatePairsOff[bool] = False
    """Fail (exit status 2) if a motion does not pass all checks."""

    def run(self) -> None:
        from probmotion.files import writable_folder
        from probmotion.io.keypoints.files import read_keypoints
        from probmotion.lifting.track_lift import lift

        size = (float(self.image_size[0]), float(self.image_size[1]))
        tracks = read_keypoints(self.keypoints, self.fps, self.skeleton, self.people, size)
        if self.person is not None:
            if not 0 <= self.person < len(tracks):
                raise ValueError(f"person must be 0 to {len(tracks) - 1}, got {self.person}")
            tracks = [tracks[self.person]]
        writable_folder(self.out)
        doubtful, refused = [], []
        for number, track in enumerate(tracks):
            folder = self.out if len(tracks) == 1 else self.out / f"person-{number}"
            try:
                result = lift(
                    track,
                    image_size=self.image_size,
                    fov=self.fov,
                    pitch=self.pitch,
                    height=self.height,
                    draws=self.draws,
                    seed=self.seed,
                )
            except ValueError as error:
                if len(tracks) == 1:
                    raise
                refused.append(error)
                print(f"person {number} was not lifted: {error}")
                continue
            result.save(folder)
            print("\n".join(result.summary()))
            print(f"wrote {folder / 'lift.html'}, lift.bvh, lift.glb, lift.npz, summary.json")
            if not result.trusted:
                doubtful.append(str(folder))
        if len(refused) == len(tracks):
            raise refused[0]
        if self.strict and doubtful:
            raise ValueError(
                f"motions must pass all checks with --strict, got failures in "
                f"{', '.join(doubtful)}; see lift.html"
            )

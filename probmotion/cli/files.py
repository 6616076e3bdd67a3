"""The commands ``probmotion show | convert``: what is in a file, and files of other kinds of it.

They are dataclasses whose fields are their options, as in :mod:`probmotion.cli`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from probmotion.motion.motion import Motion

__all__ = ["Convert", "Show", "file_called"]


def file_called(path: Path) -> Path:
    """Return the file of the network that comes with the package, where a path is its name."""
    if path.suffix or path.exists():
        return path
    from probmotion import models

    shipped = Path(models.__file__).parent / "weights" / f"{path}.safetensors"
    return shipped if shipped.is_file() else path


@dataclass(frozen=True)
class Show:
    """Say what is in a file of motion (.bvh, .npz), keypoints (.json, .npz, .csv), draws (.nc) or
    a trained network (.safetensors)."""

    file: Positional[Path]
    """The file; of a network also the folder of its run, or the name of one in the package."""

    fps: float | None = None
    """Frames per second of keypoints in JSON or a table, which do not hold it."""

    skeleton: str | None = None
    """What keypoints in JSON are of (see probmotion list), where their number does not tell, or
    which joints to take from a table."""

    picture: Path | None = None
    """Also draw the motion, or the first draws, to this .png."""

    def run(self) -> None:
        """Print a few lines about the file."""
        from probmotion.cli.summaries import summarise

        summary = summarise(file_called(self.file), self.fps, self.skeleton)
        print(summary.text)
        if self.picture is not None:
            summary.draw(self.picture)
            print(f"wrote {self.picture}")


@dataclass(frozen=True)
class Convert:
    """Write a motion to another format, frame rate or skeleton."""

    source: Annotated[Positional[Path], arg(name="IN")]
    """The motion (.bvh, .npz) or draws (.nc)."""

    target: Annotated[Positional[Path], arg(name="OUT")]
    """What to write; the ending chooses the format: .bvh or .npz."""

    fps: float | None = None
    """Resample to this frame rate."""

    skeleton: str | None = None
    """Retarget to this skeleton (see probmotion list)."""

    draw: int | None = None
    """Which draw of the first chain, where IN holds draws; the first by default."""

    def run(self) -> None:
        """Read, change, write."""
        from probmotion.io.files import save_motion

        motion = self._read()
        if self.fps is not None:
            motion = motion.resample(self.fps)
        if self.skeleton is not None:
            from probmotion.motion.skeleton import Skeleton

            motion = motion.retarget(Skeleton.preset(self.skeleton))
        save_motion(motion, self.target)
        print(f"wrote {self.target}: {motion}")

    def _read(self) -> Motion:
        from probmotion.io.files import load_motion
        from probmotion.posteriors.draws import MotionDraws

        if self.source.suffix != ".nc":
            if self.draw is not None:
                raise ValueError(f"draw is {self.draw}, but {self.source} holds no draws (.nc)")
            return load_motion(self.source)
        draws = MotionDraws.load(self.source)
        count = draws.dataset.sizes["draw"]
        draw = 0 if self.draw is None else self.draw
        if not 0 <= draw < count:
            raise ValueError(f"draw must be 0 to {count - 1}, got {draw}")
        return draws.motion(draw)

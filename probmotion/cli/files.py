"""The commands ``probmotion show`` and ``probmotion convert``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from probmotion.motion.motion import Motion

__all__ = ["Convert", "Show", "file_called"]


def file_called(path: Path) -> Path:
    """Return the file of a shipped network if ``path`` is the name of one, else ``path``."""
    if path.suffix or path.exists():
        return path
    from probmotion import models

    shipped = Path(models.__file__).parent / "weights" / f"{path}.safetensors"
    return shipped if shipped.is_file() else path


@dataclass(frozen=True)
class Show:
    """Summarise a file of motion (.bvh, .npz), keypoints (.json, .npz, .csv), draws (.nc) or a
    trained network (.safetensors).
    """

    file: Positional[Path]
    """File, folder of a training run, or name of a shipped network."""

    fps: float | None = None
    """Frame rate of keypoints in JSON or a table, frames per second."""

    skeleton: str | None = None
    """Layout of JSON keypoints or joints to read from a table (see probmotion list)."""

    figure: Path | None = None
    """Also write a figure of the motion, or of the first draws, to this .png file."""

    def run(self) -> None:
        from probmotion.cli.summaries import summarise

        summary = summarise(file_called(self.file), self.fps, self.skeleton)
        print(summary.text)
        if self.figure is not None:
            summary.draw(self.figure)
            print(f"wrote {self.figure}")


@dataclass(frozen=True)
class Convert:
    """Convert a motion to another format, frame rate or skeleton."""

    source: Annotated[Positional[Path], arg(name="IN")]
    """Motion (.bvh, .npz) or draws (.nc)."""

    target: Annotated[Positional[Path], arg(name="OUT")]
    """Output file, .bvh or .npz."""

    fps: float | None = None
    """Frame rate to resample to, frames per second."""

    skeleton: str | None = None
    """Skeleton to retarget to (see probmotion list)."""

    draw: int | None = None
    """Index of the draw in the first chain of IN; 0 by default."""

    def run(self) -> None:
        from probmotion.io.files import save

        motion = self._read()
        if self.fps is not None:
            motion = motion.resample(self.fps)
        if self.skeleton is not None:
            from probmotion.motion.skeleton import Skeleton

            motion = motion.retarget(Skeleton.preset(self.skeleton))
        save(motion, self.target)
        print(f"wrote {self.target}: {motion}")

    def _read(self) -> Motion:
        from probmotion.io.files import load
        from probmotion.posteriors.draws import MotionDraws

        if self.source.suffix != ".nc":
            if self.draw is not None:
                raise ValueError(f"draw requires a file of draws (.nc), got {self.source}")
            return load(self.source)
        draws = MotionDraws.load(self.source)
        count = draws.dataset.sizes["draw"]
        draw = 0 if self.draw is None else self.draw
        if not 0 <= draw < count:
            raise ValueError(f"draw must be 0 to {count - 1}, got {draw}")
        return draws.motion(draw)

"""The commands ``probmotion show``, ``report`` and ``convert``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

if TYPE_CHECKING:
    from probmotion.motion.motion import Motion

__all__ = ["Conventions", "Convert", "Report", "Show", "file_called"]


def file_called(path: Path) -> Path:
    """Return the file of a shipped network if ``path`` is the name of one, else ``path``."""
    if path.suffix or path.exists():
        return path
    from probmotion import models

    shipped = Path(models.__file__).parent / "weights" / f"{path}.safetensors"
    return shipped if shipped.is_file() else path


@dataclass(frozen=True, kw_only=True)
class Conventions:
    """Unit and axes of motion files."""

    unit: Annotated[
        Literal["m", "cm", "mm", "in"] | None, arg(metavar="UNIT", help_behavior_hint="")
    ] = None
    """Unit of .npz (default: m) and .bvh files (default: inferred): m, cm, mm or in."""

    up: Annotated[Literal["y", "z"] | None, arg(metavar="AXIS", help_behavior_hint="")] = None
    """Vertical axis of motion files, y or z; the declared one, or else y, by default."""

    mirror: FlagCreatePairsOff[bool] = False
    """Reflect x, for motion files in left-handed axes."""

    def conventions(self) -> dict[str, Any]:
        """Return the arguments of :func:`probmotion.load`."""
        return {"unit": self.unit, "up": self.up, "mirror": self.mirror}


@dataclass(frozen=True)
class Show(Conventions):
    """Summarise a file, or a network, sampler or problem by name.

    Files contain motion (.bvh, .npz), keypoints (.json, .csv, .h5, .nc, .npz), draws (.nc) or a
    network (.safetensors). The summary of a sampler lists its settings.
    """

    file: Positional[Path]
    """File, folder of a training run, or name of a shipped network, sampler, preset or problem."""

    fps: float | None = None
    """Frame rate of keypoints, frames per second; the file's by default."""

    skeleton: str | None = None
    """Layout of JSON keypoints or joints to read from a table (see probmotion list)."""

    image_size: Annotated[
        tuple[float, float] | None, arg(metavar="WIDTH HEIGHT", help_behavior_hint="")
    ] = None
    """Size of the image in pixels, for normalised landmarks of MediaPipe."""

    figure: Path | None = None
    """Also write a figure of the motion, first draws or keypoints to this .png, .pdf or .svg."""

    def run(self) -> None:
        path = file_called(self.file)
        if not path.exists():
            from probmotion.cli.named_summaries import summarise_named

            text = summarise_named(str(path))
            if text is not None:
                print(text)
                return
        from probmotion.cli.summaries import summarise

        keypoints = (self.fps, self.skeleton, self.image_size)
        summary = summarise(path, *keypoints, **self.conventions())
        print(summary.text)
        if self.figure is not None:
            summary.draw(self.figure)
            print(f"wrote {self.figure}")


@dataclass(frozen=True)
class Report:
    """Write the report of a comparison again, from its folder; the comparison may be unfinished."""

    folder: Positional[Path]
    """Folder of the comparison, the --out of probmotion compare."""

    out: Path | None = None
    """HTML file to write; FOLDER/report.html by default."""

    def run(self) -> None:
        from probmotion.calibration.result import Calibration
        from probmotion.comparison.grid import Comparison

        comparison = Comparison.load(self.folder)
        calibrated = any((self.folder / Calibration.FOLDER).glob("comparison.json"))
        calibration = Calibration.load(self.folder) if calibrated else None
        out = self.folder / "report.html" if self.out is None else self.out
        print(f"report: {comparison.report(out, calibration)}")


@dataclass(frozen=True)
class Convert(Conventions):
    """Convert a motion to another format, frame rate or skeleton.

    Output files .bvh and .glb contain rigid bones with rotations, .trc and .csv positions only.
    """

    source: Annotated[Positional[Path], arg(name="IN")]
    """Motion (.bvh, .npz) or draws (.nc)."""

    target: Annotated[Positional[Path], arg(name="OUT")]
    """Output file: .bvh, .glb, .npz, .trc or .csv."""

    fps: float | None = None
    """Frame rate to resample to, frames per second."""

    skeleton: str | None = None
    """Skeleton to retarget to (see probmotion list). smpl22 has rotations, and joints of the trunk
    and feet by fixed proportions if IN lacks them."""

    draw: int | None = None
    """Index of the draw in the first chain of IN; 0 by default."""

    def run(self) -> None:
        from probmotion.io.files import save

        motion = self._read()
        if self.fps is not None:
            motion = motion.resample(self.fps)
        if self.skeleton is not None:
            from probmotion.io.smpl import smpl_motion
            from probmotion.motion.skeleton import Skeleton

            if self.skeleton == "smpl22":
                motion = smpl_motion(motion)
            else:
                motion = motion.retarget(Skeleton.preset(self.skeleton))
        save(motion, self.target)
        print(f"wrote {self.target}: {motion}")

    def _read(self) -> Motion:
        from probmotion.io.files import load
        from probmotion.posteriors.draws import MotionDraws

        if self.source.suffix != ".nc":
            if self.draw is not None:
                raise ValueError(f"draw requires a file of draws (.nc), got {self.source}")
            return load(self.source, **self.conventions())
        draws = MotionDraws.load(self.source)
        count = draws.dataset.sizes["draw"]
        draw = 0 if self.draw is None else self.draw
        if not 0 <= draw < count:
            raise ValueError(f"draw must be 0 to {count - 1}, got {draw}")
        return draws.motion(draw)

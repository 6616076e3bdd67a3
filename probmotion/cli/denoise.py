"""The command ``probmotion denoise``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from probmotion.cli.files import Conventions

if TYPE_CHECKING:
    from probmotion.motion.motion import JointTrack

__all__ = ["Denoise"]

_OUTLIERS = 3.0  # degrees of freedom of Student-t noise
_LARGEST_NOISE = 1.0  # metres


@dataclass(frozen=True, kw_only=True)
class Denoise(Conventions):
    """Denoise a person's recorded 3D joints and fill gaps, with a prior of human motion.

    Writes denoised.npz (posterior mean, standard deviation and draws) and mean.bvh to --out and
    replaces existing files of these names.
    """

    file: Positional[Path]
    """Recording: .npz with NaN as gaps, .bvh, or .trc or .c3d with joint centres as markers."""

    out: Path
    """Output folder."""

    unit: Annotated[
        Literal["m", "cm", "mm", "in"] | None, arg(metavar="UNIT", help_behavior_hint="")
    ] = None
    """Unit of lengths: m, cm, mm or in.
    Default: m for .npz, declared by .trc and .c3d, inferred for .bvh."""

    noise: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """Noise standard deviation of a coordinate, metres; estimated by default."""

    outliers: FlagCreatePairsOff[bool] = False
    """Student-t noise with 3 degrees of freedom, for recordings with outliers."""

    correct: FlagCreatePairsOff[bool] = False
    """Correct mean and draws with networks (.1 to .2 s per frame, needs torch)."""

    draws: int = 20
    """Number of posterior draws."""

    seed: int = 0
    """Seed of the draws."""

    def run(self) -> None:
        from probmotion.files import check_writable
        from probmotion.io.errors import errors_in
        from probmotion.io.files import read_joints
        from probmotion.models.mixture.denoising import denoise_joints
        from probmotion.motion.skeleton import Skeleton
        from probmotion.validation import check_count, check_positive

        if self.noise is not None:
            check_positive("noise", self.noise)
            if self.noise > _LARGEST_NOISE:
                raise ValueError(
                    f"noise must be at most {_LARGEST_NOISE:g} m, got {self.noise:g}; is it in "
                    "metres?"
                )
        check_count("draws", self.draws)
        check_count("seed", self.seed, least=0)
        track = read_joints(self.file, **self.conventions())
        with errors_in(self.file):
            track = track.retarget(Skeleton.preset("person14"))
        check_writable(self.out)
        corrector = None
        if self.correct:
            from probmotion.problems.joint_correction import correct_joints, shipped_corrector

            corrector = shipped_corrector()  # without torch, this fails before minutes of work
        result = denoise_joints(
            track.joints,
            None,
            skeleton=track.skeleton,
            fps=track.fps,
            noise=self.noise,
            degrees_of_freedom=_OUTLIERS if self.outliers else None,
            draws=self.draws,
            seed=self.seed,
            progress=True,
        )
        if corrector is not None:
            result = correct_joints(result, fps=track.fps, corrector=corrector, seed=self.seed)
        _write(track, result, self.out)
        print(_summary(track, result, self.file, self.noise is None))
        print(
            f"wrote {self.out / 'denoised.npz'} (mean, standard deviation and {self.draws} draws) "
            f"and {self.out / 'mean.bvh'} (mean)"
        )


def _write(track: JointTrack, result: Any, out: Path) -> None:
    """Write ``denoised.npz`` and ``mean.bvh``."""
    from probmotion.files import written_together
    from probmotion.io.bvh_writing import write_bvh
    from probmotion.io.npz import write_npz
    from probmotion.motion.motion import Motion

    mean = Motion(result.mean, track.skeleton, track.fps, name=track.name)
    posterior = {"sd": result.sd, "draws": result.draws, "noise": result.noise}
    with written_together(out) as unfinished:
        write_npz(mean, unfinished / "denoised.npz", posterior)
        write_bvh(mean, unfinished / "mean.bvh")


def _summary(track: JointTrack, result: Any, path: Path, estimated: bool) -> str:
    """Return two sentences about the recording and the result."""
    import numpy as np

    seen = track.seen
    never = np.array(track.skeleton.joint_names)[~seen.any(axis=0)]
    filled = f"; never observed, filled by the prior: {', '.join(never)}" if len(never) else ""
    deviations = [f"{100 * result.sd[seen].mean():.2g} cm at observed joints"]
    if not seen.all():
        deviations.append(f"{100 * result.sd[~seen].mean():.2g} cm at missing joints")
    return (
        f"{path}: {track.frames} frames at {track.fps:g} fps, {track.skeleton.n_joints} joints, "
        f"{1 - seen.mean():.1%} of joint positions missing{filled}\n"
        f"noise: {100 * result.noise:.2g} cm ({'estimated' if estimated else 'given'}); mean "
        f"posterior standard deviation: {', '.join(deviations)}"
    )

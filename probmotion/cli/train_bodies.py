"""The commands ``probmotion train dvae`` and ``probmotion train denoiser``."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import OmitArgPrefixes

from probmotion.cli.training_options import (
    Steps,
    check_enough_clips,
    check_out,
    listed_clips,
    run_training,
)

if TYPE_CHECKING:
    from probmotion.motion.motion import Motion
    from probmotion.motion.skeleton import Skeleton

__all__ = ["TrainDVAE", "TrainDenoiser"]

Size = Literal["tiny", "small", "paper"]


@dataclass(frozen=True)
class BodyClips:
    """3D clips for training; by default synthetic people who walk, run and march."""

    clips: tuple[str, ...] = ()
    """3D motion files (.npz, .bvh) or quoted patterns."""

    validation: tuple[str, ...] = ()
    """Names of validation clips (files without extension); a random tenth by default."""

    test: tuple[str, ...] = ()
    """Names of held-out test clips; a random tenth by default."""

    data_seed: int = 0
    """Seed of the random split, or of the synthetic clips."""


@dataclass(frozen=True)
class Noise:
    """Noise added to the joints of the clips."""

    least: float = 0.01
    """Minimum standard deviation of the noise, metres."""

    most: float = 0.08
    """Maximum standard deviation of the noise, metres."""

    outliers: float = 0.4
    """Fraction of windows with outliers (Student-t noise)."""

    hidden: float = 0.6
    """Fraction of windows with occluded limbs and joints."""


@dataclass(frozen=True)
class TrainDVAE:
    """Train a Motion-DVAE, an autoregressive prior over 3D motion, from clean clips.

    Writes model.safetensors and losses.csv. Run the same command again to resume an interrupted
    run; increase --steps to extend a finished one.
    """

    out: Path
    """Output folder."""

    size: Size = "small"
    """Network size; tiny trains in seconds, small in minutes on two cores, paper needs a GPU."""

    skeleton: str = "person14"
    """Skeleton (see probmotion list)."""

    fps: float = 30.0
    """Training frame rate, frames per second; other clips are resampled."""

    data: OmitArgPrefixes[BodyClips] = field(default_factory=BodyClips)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        from probmotion.models.bodies.body_states import BodyStates, rest_pose
        from probmotion.models.dvae.settings import DVAESettings
        from probmotion.models.dvae.training import DVAETrainee, usual_dvae_training
        from probmotion.motion.skeleton import Skeleton
        from probmotion.validation import check_positive

        defaults, annealing = usual_dvae_training(self.size)
        settings = self.training.settings(defaults)
        check_out(self.out)
        check_positive("fps", self.fps)
        skeleton = Skeleton.preset(self.skeleton)
        size = getattr(DVAESettings, self.size)()
        parts = _learning_clips(self.data, skeleton, self.fps, size.frames)
        _print_annealing(annealing, settings.steps)
        clips = parts["train"]
        states = BodyStates(skeleton, rest_pose(skeleton, [clip.positions for clip in clips]))
        trainee = DVAETrainee(
            clips, parts["validation"], size, states, annealing=annealing, seed=settings.seed
        )
        run_training(trainee, settings, self.out, self.training.device)


@dataclass(frozen=True)
class TrainDenoiser:
    """Train a denoiser of 3D joints with a Motion-DVAE prior, from noisy joints alone.

    Noisy joints are generated from clips with the prior's skeleton and frame rate. Writes
    model.safetensors and losses.csv. Run the same command again to resume an interrupted run;
    increase --steps to extend a finished one.
    """

    out: Path
    """Output folder."""

    prior: str
    """Motion-DVAE prior: folder or file written by probmotion train dvae, or a shipped network.
    Its weights are frozen."""

    size: Size = "small"
    """Size of the prior, which selects default settings; tiny takes seconds, paper needs a GPU."""

    noise: OmitArgPrefixes[Noise] = field(default_factory=Noise)
    data: OmitArgPrefixes[BodyClips] = field(default_factory=BodyClips)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        from probmotion.models.dvae.denoiser_training import (
            DenoiserTrainee,
            usual_denoiser_training,
        )
        from probmotion.models.dvae.joint_noise import JointNoise
        from probmotion.models.dvae.motion_dvae import MotionDVAE

        defaults, annealing = usual_denoiser_training(self.size)
        settings = self.training.settings(defaults)
        check_out(self.out)
        noise = JointNoise(**asdict(self.noise))
        prior = MotionDVAE.load(self.prior)
        print(
            f"prior: {prior.skeleton.n_joints} joints, windows of {prior.frames} frames at "
            f"{prior.fps:g} fps"
        )
        parts = _learning_clips(self.data, prior.skeleton, prior.fps, prior.frames)
        _print_annealing(annealing, settings.steps)
        trainee = DenoiserTrainee(
            parts["train"],
            parts["validation"],
            prior,
            noise=noise,
            annealing=annealing,
            seed=settings.seed,
        )
        run_training(trainee, settings, self.out, self.training.device)


def _learning_clips(
    data: BodyClips, skeleton: Skeleton, fps: float, frames: int
) -> dict[str, list[Motion]]:
    """Return the selected clips of at least ``frames`` frames by part, and print their names."""
    from probmotion.data.denoising_clips import synthetic_denoising_clips
    from probmotion.data.tracks.learning import split_names, unique_files
    from probmotion.io.files import load
    from probmotion.validation import check_count

    check_count("data_seed", data.data_seed, least=0)
    if data.clips:
        clips = [replace(load(p), name=name) for name, p in unique_files(data.clips).items()]
        clips = _long_clips(clips, skeleton, fps, frames)
        names = [clip.name for clip in clips]
        if not (data.validation or data.test):
            check_enough_clips(names)
        split = split_names(names, validation=data.validation, test=data.test, seed=data.data_seed)
        parts = {
            part: [clip for clip in clips if clip.name in getattr(split, part)]
            for part in ("train", "validation", "test")
        }
    else:
        for name in ("validation", "test"):
            if getattr(data, name):
                raise ValueError(f"{name} requires --clips FILE…")
        synthetic = synthetic_denoising_clips(seed=data.data_seed)
        generated = [clip for clips in synthetic.values() for clip in clips]
        long = {clip.name: clip for clip in _long_clips(generated, skeleton, fps, frames)}
        parts = {part: [long[clip.name] for clip in clips] for part, clips in synthetic.items()}
    for part, clips in parts.items():
        count = sum(clip.frames for clip in clips)
        names = [clip.name for clip in clips]
        print(f"{part}: {count} frames of {listed_clips(names)}")
    return parts


def _long_clips(clips: list[Motion], skeleton: Skeleton, fps: float, frames: int) -> list[Motion]:
    """Retarget and resample clips, and drop clips shorter than ``frames``."""
    from probmotion.models.bodies.body_states import check_bones

    rates = Counter(clip.fps for clip in clips if clip.fps != fps)
    resampled = [_retargeted(clip, skeleton).resample(fps) for clip in clips]
    for rate, count in sorted(rates.items()):
        print(f"resampled from {rate:g} to {fps:g} fps: {count} of {len(clips)} clips")
    parents = [max(parent, 0) for parent in skeleton.parents]
    for clip in resampled:
        check_bones(clip.name, clip.positions[0] - clip.positions[0, parents], skeleton)
    long = [clip for clip in resampled if clip.frames >= frames]
    if not long:
        raise ValueError(
            f"clips must include one of at least {frames} frames at {fps:g} fps, got at most "
            f"{max(clip.frames for clip in resampled)} frames"
        )
    if short := [clip.name for clip in resampled if clip.frames < frames]:
        print(f"skipped, shorter than {frames} frames: {listed_clips(short)}")
    return long


def _retargeted(clip: Motion, skeleton: Skeleton) -> Motion:
    try:
        return clip.retarget(skeleton)
    except ValueError as error:
        raise ValueError(f"clip {clip.name} cannot be retargeted: {error}") from error


def _print_annealing(annealing: int, steps: int) -> None:
    note = "" if annealing <= steps else f", but this run has {steps}"
    print(f"KL annealing takes {annealing} steps{note}")

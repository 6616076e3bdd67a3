"""The commands ``probmotion train dvae | denoiser``: what bodies do, learnt from 3D clips.

Each is a dataclass whose fields are its options, as in :mod:`probmotion.cli`.
"""

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
    listed,
    run_training,
)

if TYPE_CHECKING:
    from probmotion.motion.motion import Motion
    from probmotion.motion.skeleton import Skeleton
    from probmotion.motion.splits import Split

__all__ = ["TrainDVAE", "TrainDenoiser", "learning_clips"]

Size = Literal["tiny", "small", "paper"]


@dataclass(frozen=True)
class BodyClips:
    """What is learnt from: 3D clips of bodies; people made to walk, run and march by default."""

    clips: tuple[str, ...] = ()
    """3D motion files, .npz or .bvh, or quoted patterns."""

    validation: tuple[str, ...] = ()
    """Names of clips (files without ending) on which the loss is watched; a tenth by default."""

    test: tuple[str, ...] = ()
    """Names of clips that are kept for measuring; a tenth by default."""

    data_seed: int = 0
    """Seed of the split or, where no clips are named, of the people who are made."""


@dataclass(frozen=True)
class Noise:
    """What the recordings are like that the denoiser is to learn from."""

    least: float = 0.01
    """Least standard deviation of a joint's coordinate, metres."""

    most: float = 0.08
    """Greatest standard deviation of a joint's coordinate, metres."""

    outliers: float = 0.4
    """Share of windows whose noise has outliers (Student-t)."""

    hidden: float = 0.6
    """Share of windows in which limbs hide for a while, and single joints here and there."""


@dataclass(frozen=True)
class TrainDVAE:
    """Learn a Motion-DVAE, a prior of what a body does next, from clean 3D motion.

    The same command goes on where it was stopped; a run that is finished goes on with more steps.
    """

    out: Path
    """Folder for model.safetensors, losses.csv and what is needed to go on."""

    size: Size = "small"
    """tiny: seconds, for trying out; small: minutes on two cores; paper: a GPU."""

    skeleton: str = "person14"
    """The joints to learn (see probmotion list), which clips must have."""

    fps: float = 30.0
    """Frames per second to learn at; clips at another rate are resampled."""

    data: OmitArgPrefixes[BodyClips] = field(default_factory=BodyClips)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train."""
        from probmotion.models.bodies.body_states import BodyStates, rest_pose
        from probmotion.models.dvae.settings import DVAESettings
        from probmotion.models.dvae.training import DVAETrainee, usual_dvae_training
        from probmotion.motion.skeleton import Skeleton
        from probmotion.validation import check_positive

        usual, annealing = usual_dvae_training(self.size)
        settings = self.training.settings(usual)
        check_out(self.out)
        check_positive("fps", self.fps)
        skeleton = Skeleton.preset(self.skeleton)
        size = getattr(DVAESettings, self.size)()
        parts = learning_clips(self.data, skeleton, self.fps, size.frames)
        _say_annealing(annealing, settings.steps)
        clips = parts["train"]
        states = BodyStates(skeleton, rest_pose(skeleton, [clip.positions for clip in clips]))
        trainee = DVAETrainee(
            clips, parts["validation"], size, states, annealing=annealing, seed=settings.seed
        )
        run_training(trainee, settings, self.out, self.training.device)


@dataclass(frozen=True)
class TrainDenoiser:
    """Learn to denoise 3D joints with a Motion-DVAE, from noisy joints alone.

    Clips only make the noisy joints. They are brought to the joints and the frame rate of the
    prior. The same command goes on where it was stopped.
    """

    out: Path
    """Folder for model.safetensors, losses.csv and what is needed to go on."""

    prior: str
    """What motion is like: the folder or file of a run of probmotion train dvae, or the name of
    one in the package. It stays as it is."""

    size: Size = "small"
    """How long to learn, by the prior's size. tiny: seconds, for trying out; small: minutes on two
    cores; paper: a GPU."""

    noise: OmitArgPrefixes[Noise] = field(default_factory=Noise)
    data: OmitArgPrefixes[BodyClips] = field(default_factory=BodyClips)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train."""
        from probmotion.models.dvae.denoiser_training import (
            DenoiserTrainee,
            usual_denoiser_training,
        )
        from probmotion.models.dvae.joint_noise import JointNoise
        from probmotion.models.dvae.motion_dvae import MotionDVAE

        usual, annealing = usual_denoiser_training(self.size)
        settings = self.training.settings(usual)
        check_out(self.out)
        noise = JointNoise(**asdict(self.noise))
        prior = MotionDVAE.load(self.prior)
        print(
            f"prior: {prior.skeleton.n_joints} joints, windows of {prior.frames} frames at "
            f"{prior.fps:g} fps"
        )
        parts = learning_clips(self.data, prior.skeleton, prior.fps, prior.frames)
        _say_annealing(annealing, settings.steps)
        trainee = DenoiserTrainee(
            parts["train"],
            parts["validation"],
            prior,
            noise=noise,
            annealing=annealing,
            seed=settings.seed,
        )
        run_training(trainee, settings, self.out, self.training.device)


def learning_clips(
    data: BodyClips, skeleton: Skeleton, fps: float, frames: int
) -> dict[str, list[Motion]]:
    """Return the clips of each part that the options name, and print what was done to them.

    Parameters
    ----------
    data : BodyClips
        The options.
    skeleton : Skeleton
        The joints to bring clips to.
    fps : float
        Frames per second to bring them to.
    frames : int
        Of a window: shorter clips are left out.
    """
    from probmotion.data.denoising_clips import synthetic_denoising_clips
    from probmotion.validation import check_count

    check_count("data_seed", data.data_seed, least=0)
    if data.clips:
        found = _long_clips(_read_clips(data.clips), skeleton, fps, frames)
        split = _split(data, [clip.name for clip in found])
        parts = {
            part: [clip for clip in found if clip.name in getattr(split, part)]
            for part in ("train", "validation", "test")
        }
    else:
        for name in ("validation", "test"):
            if getattr(data, name):
                raise ValueError(f"{name} is given without clips, expected --clips FILE… beside it")
        made = synthetic_denoising_clips(seed=data.data_seed)
        every = [clip for clips in made.values() for clip in clips]
        long = {clip.name: clip for clip in _long_clips(every, skeleton, fps, frames)}
        parts = {part: [long[clip.name] for clip in clips] for part, clips in made.items()}
    for part, clips in parts.items():
        count = sum(clip.frames for clip in clips)
        names = listed([clip.name for clip in clips])
        print(f"{part}: {count} frames of {len(clips)} clips: {names}")
    return parts


def _read_clips(paths: tuple[str, ...]) -> list[Motion]:
    """Return the motions of files, each called as its file."""
    from probmotion.io.files import files_named, load_motion

    files: dict[str, Path] = {}
    for path in files_named(paths):
        if path.stem in files:
            raise ValueError(
                f"clips has {files[path.stem]} and {path}, expected files of other names: a clip "
                "is called as its file"
            )
        files[path.stem] = path
    return [replace(load_motion(path), name=name) for name, path in files.items()]


def _long_clips(clips: list[Motion], skeleton: Skeleton, fps: float, frames: int) -> list[Motion]:
    """Return clips on the skeleton at the frame rate, without those shorter than a window."""
    from probmotion.models.bodies.body_states import check_bones

    rates = Counter(clip.fps for clip in clips if clip.fps != fps)
    found = [_on(skeleton, clip).resample(fps) for clip in clips]
    for rate, count in sorted(rates.items()):
        print(f"resampled to {fps:g} fps: {count} clips at {rate:g} fps")
    for clip in found:
        parents = [max(parent, 0) for parent in skeleton.parents]
        check_bones(clip.name, clip.positions[0] - clip.positions[0, parents], skeleton)
    long = [clip for clip in found if clip.frames >= frames]
    if not long:
        raise ValueError(
            f"clips has none of {frames} frames or more at {fps:g} frames per second, expected "
            f"some; the longest has {max(clip.frames for clip in found)}"
        )
    if short := [clip.name for clip in found if clip.frames < frames]:
        print(f"left out, shorter than {frames} frames: {len(short)} clips: {listed(short)}")
    return long


def _on(skeleton: Skeleton, clip: Motion) -> Motion:
    try:
        return clip.retarget(skeleton)
    except ValueError as error:
        raise ValueError(f"clips has {clip.name}, which cannot be learnt from: {error}") from error


def _split(data: BodyClips, names: list[str]) -> Split:
    """Return the clips of each part: those that are named, or a tenth each at random."""
    from probmotion.motion.splits import Split, split_clips

    if not (data.validation or data.test):
        check_enough_clips(names)
        return split_clips(names, seed=data.data_seed)
    for given, missing in (("validation", "test"), ("test", "validation")):
        if not getattr(data, missing):
            raise ValueError(
                f"{given} is given without {missing}, expected clips for both or neither"
            )
        for name in getattr(data, given):
            if name not in names:
                raise ValueError(
                    f"{given} has {name!r}, which names no clip, expected some of "
                    f"{', '.join(sorted(names))}"
                )
    if twice := sorted(set(data.validation) & set(data.test)):
        raise ValueError(f"test has {twice[0]!r}, which validation has too, expected other clips")
    rest = sorted(set(names) - set(data.validation) - set(data.test))
    if not rest:
        raise ValueError("validation and test have every clip, expected some to learn from")
    return Split(tuple(rest), tuple(sorted(data.validation)), tuple(sorted(data.test)))


def _say_annealing(annealing: int, steps: int) -> None:
    within = "" if annealing <= steps else f", more than the {steps} to take"
    print(f"the weight of KL rises over {annealing} steps{within}")

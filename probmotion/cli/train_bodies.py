"""The commands ``probmotion train dvae``, ``denoiser`` and ``images``."""

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
    from probmotion.models.images.category import Category
    from probmotion.models.images.encoder import EncoderNetwork
    from probmotion.models.images.observation import ImageObservation
    from probmotion.models.training.settings import TrainingSettings
    from probmotion.motion.motion import Motion
    from probmotion.motion.skeleton import Skeleton

__all__ = ["TrainDVAE", "TrainDenoiser", "TrainImages"]

Size = Literal["tiny", "small", "paper"]
_FRAMES, _SIZE = 5, 64  # images of a generated clip; pixels of images


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


@dataclass(frozen=True)
class TrainImages:
    """Train a kind of body for probmotion reconstruct, from clips of images and masks.

    Learns the mean surface, colours and features in rounds and writes category.npz after each; then
    trains the encoder and writes model.safetensors and losses.csv. Run the same command again to
    resume an interrupted run.
    """

    out: Path
    """Output folder."""

    category: str = "quadruped"
    """Category to start from: quadruped, person, or the file of a category."""

    clips: tuple[Path, ...] = ()
    """Folders of clips with images/NAME.png (or .jpg), masks/NAME.png and, in all clips or none,
    features/NAME.npz (image features: one array of rows, columns and channels).
    Default: generated images of an animal with another surface and coat."""

    images: int = 200
    """Number of images to learn from, evenly spread over the clips."""

    rounds: int = 2
    """Number of rounds; each estimates all poses (2.4 s per image), then surface, colours and
    features."""

    fov: float = 40.0
    """Field of view of the clips' cameras along the longer side, degrees."""

    data_seed: int = 0
    """Seed of the generated images."""

    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        from probmotion.models.images.category import Category
        from probmotion.models.images.encoder_training import KIND, EncoderTrainee
        from probmotion.models.training.runs import steps_taken
        from probmotion.models.training.settings import TrainingSettings
        from probmotion.reconstruction.learning import (
            CATEGORY,
            check_rounds,
            learn_category,
            rounds_done,
        )
        from probmotion.validation import check_count

        defaults = TrainingSettings(steps=4000, learning_rate=1.5e-3, ema=0.99)
        settings = self.training.settings(defaults)
        check_out(self.out)
        check_count("images", self.images)
        check_count("data_seed", self.data_seed, least=0)
        start = Category.load(self.category)
        images = self._images(start)
        check_rounds(start, images, self.out, self.rounds)
        done = rounds_done(self.out)
        if done < self.rounds and steps_taken(self.out, KIND):
            raise ValueError(
                f"rounds must be {done} to resume {self.out}, whose encoder was trained, got "
                f"{self.rounds}; use another folder"
            )
        if done < self.rounds:
            network = self._start_encoder(start, settings)
            learn_category(start, network, images, self.out, rounds=self.rounds)
        category = Category.load(self.out / CATEGORY)
        print(f"{self.out / CATEGORY}: images: {len(images)}, rounds: {self.rounds}")
        trainee = EncoderTrainee(category, settings.seed)
        run_training(trainee, settings, self.out, self.training.device)

    def _images(self, category: Category) -> list[ImageObservation]:
        import numpy as np

        from probmotion import seeds
        from probmotion.models.images.made_images import make_category, make_clips
        from probmotion.models.images.observation import ImageObservation

        if not self.clips:
            rng = seeds.generator(self.data_seed, "clips")
            animal = make_category(category, rng)
            count = -(-self.images // _FRAMES)
            images, _ = make_clips(animal, rng, count, _FRAMES, _SIZE)
            return images[: self.images]
        clips = [_masked_images(folder) for folder in self.clips]
        images = []
        for number, clip in enumerate(clips):
            share = (self.images + len(clips) - 1 - number) // len(clips)
            if not share:
                continue
            chosen = np.unique(np.linspace(0, len(clip) - 1, share).round().astype(int))
            for image, mask, features in (clip[k] for k in chosen):
                seen = ImageObservation.read(
                    image, mask, features=features, fov=self.fov, size=_SIZE
                )
                images.append(seen)
        return images

    def _start_encoder(self, start: Category, settings: TrainingSettings) -> EncoderNetwork:
        """Return the encoder beside the category's file, or else train one."""
        from probmotion.models.images.encoder_training import (
            EncoderTrainee,
            encoder_of,
            load_encoder,
        )

        try:
            return encoder_of(start)
        except FileNotFoundError:
            folder = self.out / "start"
            print(f"{self.category} has no encoder beside its file: trained first, in {folder}")
            trainee = EncoderTrainee(start, settings.seed)
            run_training(trainee, settings, folder, self.training.device)
            return load_encoder(folder, start)


def _masked_images(folder: Path) -> list[tuple[Path, Path, Path | None]]:
    """Return the images of a clip, their masks and features if it has any, sorted by name."""
    suffixes = {"images": {".png", ".jpg", ".jpeg"}, "masks": {".png"}, "features": {".npz"}}
    if not (folder / "features").is_dir():
        del suffixes["features"]
    found: dict[str, dict[str, Path]] = {}
    for part, allowed in suffixes.items():
        if not (folder / part).is_dir():
            raise ValueError(f"clips must be folders with images and masks, got no {folder / part}")
        files = [
            path for path in sorted((folder / part).iterdir()) if path.suffix.lower() in allowed
        ]
        found[part] = {path.stem: path for path in files}
        if not files:
            raise ValueError(
                f"clips must contain {' or '.join(sorted(allowed))}, got none in {folder / part}"
            )
        if len(found[part]) < len(files):
            raise ValueError(f"images of a clip must have unique names, got two in {folder / part}")
    images = found.pop("images")
    for part, others in found.items():
        if odd := sorted(images.keys() ^ others.keys()):
            raise ValueError(
                f"images and {part} of a clip must have the same names, got {odd[0]} in only one "
                f"of the folders of {folder}"
            )
    features = found.get("features", {})
    return [(images[name], found["masks"][name], features.get(name)) for name in images]


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

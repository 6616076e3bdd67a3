"""The command ``probmotion train``: what can be trained, and what learns from 2D tracks.

Each kind is a dataclass whose fields are its options, as in :mod:`probmotion.cli`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes

from probmotion.body_training_commands import TrainDenoiser, TrainDVAE
from probmotion.training_options import (
    Steps,
    check_enough_clips,
    check_out,
    listed,
    run_training,
)

if TYPE_CHECKING:
    from probmotion.data.learning import LearningTracks

__all__ = ["TRAINABLE", "TrainDiffusion", "TrainEvaluator", "TrainLifter"]

Size = Literal["tiny", "small", "paper", "reference-code"]


@dataclass(frozen=True)
class Data:
    """What is learnt from: clips that are filmed, or tracks; people made to walk by default."""

    clips: tuple[str, ...] = ()
    """3D motion files, .npz or .bvh, or quoted patterns. They are filmed by cameras around them,
    and a detector with errors finds the joints: only these pictures are learnt from."""

    tracks: tuple[str, ...] = ()
    """Files of 2D keypoints (.json, .npz, .csv), folders of a video's frames as OpenPose writes
    them (--tracks op/video0 op/video1), or quoted patterns. Their names are those of clips. Of
    other bodies than people, --skeleton must be named."""

    tracks_fps: float | None = None
    """Frames per second of keypoints in files that do not hold it."""

    layout: str | None = None
    """What keypoints in JSON are (see probmotion list), where their number does not tell."""

    people: int | None = None
    """How many people to follow in JSON that does not say who is who."""

    skeleton: str = "person14"
    """The joints to learn (see probmotion list), which clips or tracks must have."""

    fps: float = 20.0
    """Frames per second to learn at."""

    validation: tuple[str, ...] = ()
    """Names of clips (files without ending) on which the loss is watched; a tenth by default."""

    test: tuple[str, ...] = ()
    """Names of clips that are kept for measuring; a tenth by default."""

    views: int | None = None
    """Cameras around each 3D clip; 64 by default."""

    centre: Literal["frame", "sequence"] = "frame"
    """Whether the root is at the origin in every frame, or on average."""

    data_seed: int = 0
    """Seed of cameras, detection errors and, where no clips are named, of the split."""


@dataclass(frozen=True)
class TrainDiffusion:
    """Learn a 2D motion diffusion model, a prior that mas, mvpc and sds draw 3D motion from.

    The same command goes on where it was stopped; a run that is finished goes on with more steps.
    """

    out: Path
    """Folder for model.safetensors, losses.csv and what is needed to go on."""

    size: Size = "small"
    """tiny: seconds, for trying out; small: minutes on two cores; paper and reference-code: a
    GPU."""

    frames: int | None = None
    """Most frames of a motion; by default the size's own."""

    threshold: float = 0.3
    """Least confidence of a joint that is learnt from: .3 for people, .5 for horses, .01 with a
    ball."""

    data: OmitArgPrefixes[Data] = field(default_factory=Data)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train."""
        from probmotion.models.diffusion_settings import DiffusionSettings
        from probmotion.models.diffusion_training import DiffusionTrainee, usual_training
        from probmotion.models.track_batches import Augmentation

        preset = getattr(DiffusionSettings, self.size.replace("-", "_"))
        size = preset() if self.frames is None else preset(self.frames)
        settings = self.training.settings(usual_training(self.size))
        _check_options(self.out, self.threshold)
        found = learning_tracks(self.data, self.threshold)
        shift = 0.0 if self.data.centre == "frame" else 0.1
        trainee = DiffusionTrainee(
            found.train,
            found.validation,
            size,
            threshold=self.threshold,
            augmentation=Augmentation(shift=shift),
            seed=self.training.seed,
        )
        run_training(trainee, settings, self.out, self.training.device)


@dataclass(frozen=True)
class TrainEvaluator:
    """Learn what makes features of 2D motions, by which FID, precision and recall are measured.

    The same command goes on where it was stopped.
    """

    out: Path
    """Folder for model.safetensors, losses.csv and what is needed to go on."""

    size: Literal["tiny", "small", "reference-code"] = "small"
    """tiny: seconds, for trying out; small: minutes on two cores; reference-code: a GPU."""

    frames: int | None = None
    """Most frames of a motion; by default the size's own."""

    threshold: float = 0.3
    """Least confidence of a joint that is learnt from."""

    data: OmitArgPrefixes[Data] = field(default_factory=Data)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train."""
        from probmotion.models.evaluator_training import EvaluatorTrainee
        from probmotion.models.track_autoencoder import EvaluatorSettings
        from probmotion.models.training_settings import TrainingSettings

        if self.data.centre != "frame":
            raise ValueError(
                f"centre is {self.data.centre!r}, expected frame: draws are filmed with the root "
                "at the origin in every frame"
            )
        preset = getattr(EvaluatorSettings, self.size.replace("-", "_"))
        size = preset() if self.frames is None else preset(self.frames)
        usual = TrainingSettings(steps=1000 if self.size == "tiny" else 5000, learning_rate=1e-3)
        settings = self.training.settings(usual)
        _check_options(self.out, self.threshold)
        found = learning_tracks(self.data, self.threshold)
        trainee = EvaluatorTrainee(
            found.train,
            found.validation,
            size,
            threshold=self.threshold,
            seed=self.training.seed,
        )
        run_training(trainee, settings, self.out, self.training.device)


@dataclass(frozen=True)
class TrainLifter:
    """Learn an unsupervised lifter of 2D poses, a baseline: first the flow it learns from.

    The same command goes on where it was stopped. More steps are steps of the lifter alone: the
    flow that it has begun to learn from stays as it is.
    """

    out: Path
    """Folder for the folders flow and lifter, each with model.safetensors and losses.csv."""

    size: Literal["tiny", "small"] = "small"
    """tiny: seconds, for trying out; small: minutes on two cores."""

    threshold: float = 0.3
    """Least confidence of every joint of a pose that is learnt from."""

    data: OmitArgPrefixes[Data] = field(default_factory=Data)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train the flow, then the lifter."""
        from probmotion.models.lifter import LifterSettings
        from probmotion.models.lifter_training import LifterTrainee
        from probmotion.models.pose_flow import FlowSettings, PoseFlow
        from probmotion.models.pose_flow_training import PoseFlowTrainee
        from probmotion.models.training_runs import STATE
        from probmotion.models.training_settings import TrainingSettings

        usual = TrainingSettings(steps=1000 if self.size == "tiny" else 4000, learning_rate=1e-3)
        settings = self.training.settings(usual)
        _check_options(self.out, self.threshold)
        found = learning_tracks(self.data, self.threshold)
        device = self.training.device
        if not (self.out / "lifter" / STATE).exists():
            flow = PoseFlowTrainee(
                found.train,
                found.validation,
                getattr(FlowSettings, self.size)(),
                threshold=self.threshold,
                seed=settings.seed,
            )
            run_training(flow, settings, self.out / "flow", device)
        lifter = LifterTrainee(
            found.train,
            found.validation,
            PoseFlow.load(self.out / "flow"),
            getattr(LifterSettings, self.size)(),
            threshold=self.threshold,
            seed=settings.seed,
        )
        run_training(lifter, settings, self.out / "lifter", device)


def learning_tracks(data: Data, threshold: float = 0.3) -> LearningTracks:
    """Return the tracks that the options name, and print what preparing them dropped."""
    from probmotion.data.learning import film_clips, read_tracks, split_tracks
    from probmotion.data.projections import Filming
    from probmotion.data.splits import clip_of
    from probmotion.data.walks import made_walks
    from probmotion.motion import files_named, load_motion
    from probmotion.skeleton import Skeleton

    if data.clips and data.tracks:
        raise ValueError("clips and tracks are both given, expected one of them")
    for name in ("tracks_fps", "layout", "people"):
        if getattr(data, name) is not None and not data.tracks:
            raise ValueError(f"{name} is given without tracks, expected --tracks FILE… beside it")
    if data.tracks and data.views is not None:
        raise ValueError("views is given with tracks, expected it only where clips are filmed")
    skeleton = Skeleton.preset(data.skeleton)
    if data.tracks:
        prepared = read_tracks(
            data.tracks,
            skeleton,
            data.fps,
            file_fps=data.tracks_fps,
            layout=data.layout,
            people=data.people,
            threshold=threshold,
            centre=data.centre,
        )
    else:
        # A file may hold another name; options name clips by their files.
        clips = [replace(load_motion(path), name=path.stem) for path in files_named(data.clips)]
        prepared = film_clips(
            clips or made_walks(skeleton=skeleton),
            skeleton,
            data.fps,
            views=64 if data.views is None else data.views,
            seed=data.data_seed,
            filming=Filming(centre=data.centre),
        )
    print(prepared)
    if not (data.validation or data.test):
        check_enough_clips(clip_of(track.name) for track in prepared.tracks)
    found = split_tracks(
        prepared.tracks, validation=data.validation, test=data.test, seed=data.data_seed
    )
    for part in ("train", "validation", "test"):
        names = getattr(found.split, part)
        count = len(getattr(found, part))
        print(f"{part}: {count} tracks of {len(names)} clips: {listed(names)}")
    return found


def _check_options(out: Path, threshold: float) -> None:
    """Refuse at once what would be refused after minutes of preparing data."""
    from probmotion.checks import check_positive

    check_positive("threshold", threshold)
    check_out(out)


TRAINABLE: dict[str, type[Any]] = {
    "diffusion": TrainDiffusion,
    "evaluator": TrainEvaluator,
    "lifter": TrainLifter,
    "dvae": TrainDVAE,
    "denoiser": TrainDenoiser,
}
"""What can be trained, by name."""

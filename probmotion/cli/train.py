"""The command ``probmotion train``, and training on 2D tracks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes

from probmotion.cli.track_options import TrackData, learning_tracks
from probmotion.cli.train_bodies import TrainDenoiser, TrainDVAE, TrainImages
from probmotion.cli.train_motion_vae import TrainMotionVAE
from probmotion.cli.training_options import Steps, check_out, run_training

if TYPE_CHECKING:
    from probmotion.data.tracks.learning import LearningTracks
    from probmotion.models.training.settings import TrainingSettings

__all__ = ["TRAINABLE"]


@dataclass(frozen=True)
class _TrackTraining:
    """Options shared by the networks trained on 2D tracks."""

    out: Path
    """Output folder."""

    threshold: float = 0.3
    """Minimum joint confidence; use 0.3 for people, 0.5 for horses, 0.01 with a ball."""

    data: OmitArgPrefixes[TrackData] = field(default_factory=TrackData)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def prepared(self, defaults: TrainingSettings) -> tuple[TrainingSettings, LearningTracks]:
        """Return the training settings and the data, after validating the options."""
        from probmotion.validation import check_positive

        settings = self.training.settings(defaults)
        check_positive("threshold", self.threshold)
        check_out(self.out)
        return settings, learning_tracks(self.data, self.threshold)


@dataclass(frozen=True)
class TrainDiffusion(_TrackTraining):
    """Train a 2D motion diffusion model, a prior for the samplers mas, mvpc and sds.

    Writes model.safetensors and losses.csv. Run the same command again to resume an interrupted
    run; increase --steps to extend a finished one.
    """

    size: Literal["tiny", "small", "paper", "reference-code"] = "small"
    """Network size; tiny trains in seconds, small in minutes on two cores; others need a GPU."""

    frames: int | None = None
    """Maximum number of frames of a motion; the default depends on the size."""

    def run(self) -> None:
        from probmotion.models.diffusion.settings import DiffusionSettings
        from probmotion.models.diffusion.training import DiffusionTrainee, usual_training
        from probmotion.models.training.track_batches import Augmentation

        preset = getattr(DiffusionSettings, self.size.replace("-", "_"))
        size = preset() if self.frames is None else preset(self.frames)
        settings, tracks = self.prepared(usual_training(self.size))
        shift = 0.0 if self.data.centre == "frame" else 0.1
        trainee = DiffusionTrainee(
            tracks.train,
            tracks.validation,
            size,
            threshold=self.threshold,
            augmentation=Augmentation(shift=shift),
            seed=settings.seed,
        )
        run_training(trainee, settings, self.out, self.training.device)


@dataclass(frozen=True)
class TrainEvaluator(_TrackTraining):
    """Train the feature network of 2D motions for FID, precision and recall.

    Writes model.safetensors and losses.csv. Run the command again to resume an interrupted run.
    """

    size: Literal["tiny", "small", "reference-code"] = "small"
    """Network size; tiny trains in seconds, small in minutes on two cores; others need a GPU."""

    frames: int | None = None
    """Maximum number of frames of a motion; the default depends on the size."""

    def run(self) -> None:
        from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
        from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
        from probmotion.models.training.settings import TrainingSettings

        if self.data.centre != "frame":
            raise ValueError(f"centre must be 'frame', got {self.data.centre!r}")
        preset = getattr(EvaluatorSettings, self.size.replace("-", "_"))
        size = preset() if self.frames is None else preset(self.frames)
        defaults = TrainingSettings(steps=1000 if self.size == "tiny" else 5000, learning_rate=1e-3)
        settings, tracks = self.prepared(defaults)
        trainee = EvaluatorTrainee(
            tracks.train, tracks.validation, size, threshold=self.threshold, seed=settings.seed
        )
        run_training(trainee, settings, self.out, self.training.device)


@dataclass(frozen=True)
class TrainLifter(_TrackTraining):
    """Train a baseline: a pose flow, then an unsupervised lifter of 2D poses that uses it.

    Writes the folders flow and lifter, each with model.safetensors and losses.csv. Run the same
    command again to resume an interrupted run; increase --steps to extend the lifter only.
    """

    size: Literal["tiny", "small"] = "small"
    """Network size; tiny trains in seconds, small in minutes on two cores."""

    def run(self) -> None:
        from probmotion.models.evaluation.lifter import LifterSettings
        from probmotion.models.evaluation.lifter_training import LifterTrainee
        from probmotion.models.evaluation.pose_flow import FlowSettings, PoseFlow
        from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee
        from probmotion.models.training.runs import STATE
        from probmotion.models.training.settings import TrainingSettings

        defaults = TrainingSettings(steps=1000 if self.size == "tiny" else 4000, learning_rate=1e-3)
        settings, tracks = self.prepared(defaults)
        data = (tracks.train, tracks.validation)
        shared: dict[str, Any] = {"threshold": self.threshold, "seed": settings.seed}
        if not (self.out / "lifter" / STATE).exists():
            flow = PoseFlowTrainee(*data, getattr(FlowSettings, self.size)(), **shared)
            run_training(flow, settings, self.out / "flow", self.training.device)
        lifter = LifterTrainee(
            *data,
            PoseFlow.load(self.out / "flow"),
            getattr(LifterSettings, self.size)(),
            **shared,
        )
        run_training(lifter, settings, self.out / "lifter", self.training.device)


TRAINABLE: dict[str, type[Any]] = {
    "diffusion": TrainDiffusion,
    "evaluator": TrainEvaluator,
    "lifter": TrainLifter,
    "dvae": TrainDVAE,
    "denoiser": TrainDenoiser,
    "motion-vae": TrainMotionVAE,
    "images": TrainImages,
}
"""Trainable networks by name."""

"""The command ``probmotion train``: what can be trained, and what learns from 2D tracks.

Each kind is a dataclass whose fields are its options, as in :mod:`probmotion.cli`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tyro.conf import OmitArgPrefixes

from probmotion.cli.track_options import TrackData, learning_tracks
from probmotion.cli.train_bodies import TrainDenoiser, TrainDVAE
from probmotion.cli.train_motion_vae import TrainMotionVAE
from probmotion.cli.training_options import Steps, check_out, run_training

__all__ = ["TRAINABLE", "TrainDiffusion", "TrainEvaluator", "TrainLifter"]

Size = Literal["tiny", "small", "paper", "reference-code"]


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

    data: OmitArgPrefixes[TrackData] = field(default_factory=TrackData)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train."""
        from probmotion.models.diffusion.settings import DiffusionSettings
        from probmotion.models.diffusion.training import DiffusionTrainee, usual_training
        from probmotion.models.training.track_batches import Augmentation

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

    data: OmitArgPrefixes[TrackData] = field(default_factory=TrackData)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train."""
        from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
        from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
        from probmotion.models.training.settings import TrainingSettings

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

    data: OmitArgPrefixes[TrackData] = field(default_factory=TrackData)
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train the flow, then the lifter."""
        from probmotion.models.evaluation.lifter import LifterSettings
        from probmotion.models.evaluation.lifter_training import LifterTrainee
        from probmotion.models.evaluation.pose_flow import FlowSettings, PoseFlow
        from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee
        from probmotion.models.training.runs import STATE
        from probmotion.models.training.settings import TrainingSettings

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


def _check_options(out: Path, threshold: float) -> None:
    """Refuse at once what would be refused after minutes of preparing data."""
    from probmotion.validation import check_positive

    check_positive("threshold", threshold)
    check_out(out)


TRAINABLE: dict[str, type[Any]] = {
    "diffusion": TrainDiffusion,
    "evaluator": TrainEvaluator,
    "lifter": TrainLifter,
    "dvae": TrainDVAE,
    "denoiser": TrainDenoiser,
    "motion-vae": TrainMotionVAE,
}
"""What can be trained, by name."""

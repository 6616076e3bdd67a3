"""The command ``probmotion train motion-vae``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import OmitArgPrefixes

from probmotion.cli.track_options import TrackData, learning_tracks
from probmotion.cli.training_options import Steps, check_out, run_training

if TYPE_CHECKING:
    from probmotion.data.tracks.learning import LearningTracks
    from probmotion.models.bodies.articulated_body import ArticulatedBody

__all__ = ["TrainMotionVAE"]


@dataclass(frozen=True)
class TrainMotionVAE:
    """Train a pose network, then a motion VAE (prior over short 3D motions), on 2D tracks.

    The encoder is then calibrated twice, and a mixture is fitted to its codes of the tracks.

    Run the same command again to resume an interrupted run; increase --steps to extend
    the training of the VAE.
    """

    out: Path
    """Output folder for model.safetensors; its subfolders poses, vae and encoder contain the
    networks of the three phases and their losses.csv."""

    size: Literal["tiny", "small", "paper"] = "small"
    """Network size; tiny trains in seconds, small in 20 minutes on one core, paper needs a GPU."""

    frames: int | None = None
    """Number of frames of a motion; 10 by default."""

    kl: float | None = None
    """Weight of the KL divergence from N(0, I); 0.001 by default, as published (walk-vae: 0.01)."""

    threshold: float = 0.3
    """Minimum joint confidence; use 0.3 for people, 0.5 for horses."""

    rest: Path | None = None
    """Motion file whose first frame is the rest pose, facing +Z with hanging limbs.
    Default: mean pose estimated from the tracks. Joint limits are relative to the rest pose."""

    front: str | None = None
    """Name of a joint in front of the root, for skeletons without a known front."""

    distance: float | None = None
    """Camera distance, metres.
    Default: 7 for projected clips, infinite (orthographic) for tracks."""

    data: OmitArgPrefixes[TrackData] = field(default_factory=lambda: TrackData(fps=10.0))
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        from probmotion.data.projections import Filming
        from probmotion.models.training.checkpoints import MODEL
        from probmotion.models.training.runs import STATE
        from probmotion.models.vae.code_fitting import with_learnt_codes
        from probmotion.models.vae.motion_vae import MotionVAE
        from probmotion.models.vae.settings import MotionVAESettings
        from probmotion.models.vae.training import (
            MotionVAETrainee,
            PoseTrainee,
            usual_motion_vae_training,
        )
        from probmotion.validation import check_positive

        given = {"frames": self.frames, "kl": self.kl}
        changes = {name: value for name, value in given.items() if value is not None}
        size = replace(getattr(MotionVAESettings, self.size)(), **changes)
        phases = usual_motion_vae_training(self.size)
        poses, vae, encoder = map(self.training.settings, phases)
        check_positive("threshold", self.threshold)
        if self.distance is not None:
            check_positive("distance", self.distance)
        check_out(self.out)
        if self.data.centre != "frame":
            raise ValueError(f"centre must be 'frame', got {self.data.centre!r}")
        check_positive("fps", self.data.fps)
        # Short motions also fit into tracks of less than 1 s.
        shortest = min(1.0, size.frames / self.data.fps)
        tracks = learning_tracks(self.data, self.threshold, shortest)
        default = None if self.data.tracks else Filming().distance
        shared: dict[str, Any] = {
            "distance": default if self.distance is None else self.distance,
            "threshold": self.threshold,
            "seed": self.training.seed,
        }
        body = self._body(tracks)
        device = self.training.device
        pose_trainee = PoseTrainee(tracks.train, tracks.validation, size, body, **shared)
        if not (self.out / "vae" / STATE).exists():
            run_training(pose_trainee, poses, self.out / "poses", device)
        teacher = pose_trainee.learnt(self.out / "poses")
        trainee = MotionVAETrainee(tracks.train, tracks.validation, size, body, teacher, **shared)
        run_training(trainee, vae, self.out / "vae", device)
        prior = with_learnt_codes(
            trainee,
            MotionVAE.load(self.out / "vae", codes=None),
            encoder,
            self.out / "encoder",
            learn=partial(run_training, device=device),
        )
        prior.save(self.out / MODEL)
        print(f"wrote {self.out / MODEL}: the motion VAE with the mixture of its codes")

    def _body(self, tracks: LearningTracks) -> ArticulatedBody:
        from probmotion.io.files import load
        from probmotion.models.bodies.articulated_body import ArticulatedBody
        from probmotion.motion.rest_poses import estimate_rest_pose

        skeleton = tracks.train[0].skeleton
        if self.rest is None:
            rest = estimate_rest_pose(tracks.train, self.threshold, self.front)
            print("rest pose: the mean pose, estimated from the tracks")
        else:
            pose = load(self.rest).retarget(skeleton).positions[0]
            rest = pose - pose[[max(parent, 0) for parent in skeleton.parents]]
            print(f"rest pose: the first frame of {self.rest}")
        return ArticulatedBody(skeleton, rest)

"""What ``probmotion train motion-vae`` does: a motion VAE from 2D tracks alone, in two phases."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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
    """Learn a motion VAE, a prior of short 3D motions, from 2D tracks: first poses, then the VAE.

    The same command goes on where it was stopped. More steps are steps of the VAE alone: the poses
    that it has begun to learn from stay as they are.
    """

    out: Path
    """Folder for the folders poses and vae, each with model.safetensors and losses.csv."""

    size: Literal["tiny", "small", "paper"] = "small"
    """tiny: seconds, for trying out; small: twenty minutes of a core; paper: a GPU."""

    frames: int | None = None
    """Frames of a motion; by default the size's own, 10."""

    kl: float | None = None
    """Weight of the divergence from N(0, I); by default .001 as published. walk-vae has .01."""

    threshold: float = 0.3
    """Least confidence of a joint that is learnt from: .3 for people, .5 for horses."""

    rest: Path | None = None
    """A motion file whose first frame is the body's rest pose, looking along +Z, arms and legs as
    they hang on average: joints turn from it only so far. By default the mean pose is estimated
    from the tracks."""

    front: str | None = None
    """A joint that lies ahead of the root, where the body's joints do not say what is in front."""

    distance: float | None = None
    """Of the cameras from the subject, metres: 7 where clips are filmed; by default rays of tracks
    are parallel."""

    data: OmitArgPrefixes[TrackData] = field(default_factory=lambda: TrackData(fps=10.0))
    training: OmitArgPrefixes[Steps] = field(default_factory=Steps)

    def run(self) -> None:
        """Train the poses, then the VAE."""
        from probmotion.data.projections import Filming
        from probmotion.models.training.runs import STATE
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
        poses, vae = (
            self.training.settings(usual) for usual in usual_motion_vae_training(self.size)
        )
        check_positive("threshold", self.threshold)
        if self.distance is not None:
            check_positive("distance", self.distance)
        check_out(self.out)
        if self.data.centre != "frame":
            raise ValueError(
                f"centre is {self.data.centre!r}, expected 'frame': where the body is, is no part "
                "of the motions"
            )
        check_positive("fps", self.data.fps)
        # Motions may be shorter than what is otherwise worth keeping.
        shortest = min(1.0, size.frames / self.data.fps)
        found = learning_tracks(self.data, self.threshold, shortest)
        filmed = None if self.data.tracks else Filming().distance
        shared: dict[str, Any] = {
            "distance": filmed if self.distance is None else self.distance,
            "threshold": self.threshold,
            "seed": self.training.seed,
        }
        body = self._body(found)
        device = self.training.device
        first = PoseTrainee(found.train, found.validation, size, body, **shared)
        if not (self.out / "vae" / STATE).exists():
            run_training(first, poses, self.out / "poses", device)
        teacher = first.learnt(self.out / "poses")
        trainee = MotionVAETrainee(found.train, found.validation, size, body, teacher, **shared)
        run_training(trainee, vae, self.out / "vae", device)

    def _body(self, found: LearningTracks) -> ArticulatedBody:
        """Return the body that moves, and print where its rest pose is from."""
        from probmotion.io.files import load_motion
        from probmotion.models.bodies.articulated_body import ArticulatedBody
        from probmotion.motion.rest_poses import estimate_rest_pose

        skeleton = found.train[0].skeleton
        if self.rest is None:
            rest = estimate_rest_pose(found.train, self.threshold, self.front)
            print("the rest pose is the mean pose, estimated from the tracks")
        else:
            pose = load_motion(self.rest).retarget(skeleton).positions[0]
            parents = [max(parent, 0) for parent in skeleton.parents]
            rest = pose - pose[parents]
            print(f"the rest pose is the first frame of {self.rest}")
        return ArticulatedBody(skeleton, rest)

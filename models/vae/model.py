"""Checkpointed model of the motion VAE: both networks, settings and body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.training.checkpoints import CheckpointError, load_checkpoint, load_weights
from probmotion.models.vae.network import MotionVAENetwork
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.motion.skeleton import Skeleton

__all__ = ["KIND", "MotionVAEModel", "ReadModel", "description_of", "read_model"]

KIND = "motion-vae"


class MotionVAEModel(nn.Module):
    """Motion VAE network and pose network."""

    def __init__(self, vae: MotionVAENetwork, pose: PoseNetwork) -> None:
        super().__init__()
        self.vae = vae
        self.pose = pose

    @classmethod
    def of(cls, settings: MotionVAESettings, body: ArticulatedBody) -> MotionVAEModel:
        """Return randomly initialised networks for a body."""
        joints, bones = body.skeleton.n_joints, len(body.bones)
        return cls(
            MotionVAENetwork(settings, joints, bones),
            PoseNetwork(settings, joints, bones, body.n_groups),
        )


@dataclass(frozen=True, eq=False)
class ReadModel:
    """Contents of a checkpoint; ``fps`` in frames per second, ``card``: training record."""

    model: MotionVAEModel
    settings: MotionVAESettings
    body: ArticulatedBody
    fps: float
    card: Mapping[str, Any]


def read_model(source: str | Path) -> ReadModel:
    """Load the networks of a checkpoint: a file, the folder of a run or a shipped name.

    Raises
    ------
    CheckpointError
        If the file is damaged or not a motion VAE of this version.
    FileNotFoundError
        If there is no such file or name.
    """
    checkpoint = load_checkpoint(source, KIND)
    try:
        stored = checkpoint.settings["network"]
        settings = MotionVAESettings(**stored["size"])
        skeleton = Skeleton(stored["joint_names"], stored["parents"])
        body = ArticulatedBody(skeleton, np.array(stored["rest"], dtype=np.float64))
        model = MotionVAEModel.of(settings, body)
        fps = stored["fps"]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{source} does not contain valid motion VAE settings: {error}"
        ) from error
    load_weights(model, checkpoint.tensors)
    return ReadModel(model, settings, body, fps, checkpoint.settings)


def description_of(size: MotionVAESettings, body: ArticulatedBody, fps: float) -> dict[str, Any]:
    """Return the checkpoint settings of a motion VAE, JSON-compatible."""
    return {
        "size": asdict(size),
        "joint_names": list(body.skeleton.joint_names),
        "parents": list(body.skeleton.parents),
        "rest": body.rest.tolist(),
        "fps": fps,
    }

"""Both networks of a motion VAE, and what a checkpoint holds of them."""

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
    """Both networks of a motion VAE: what a body does, and where it is.

    Parameters
    ----------
    vae : MotionVAENetwork
        Encoder and decoder of the latent code.
    pose : PoseNetwork
        Of the rigid pose.
    """

    def __init__(self, vae: MotionVAENetwork, pose: PoseNetwork) -> None:
        super().__init__()
        self.vae = vae
        self.pose = pose

    @classmethod
    def of(cls, settings: MotionVAESettings, body: ArticulatedBody) -> MotionVAEModel:
        """Return networks of a size for a body, with fresh weights."""
        joints, bones = body.skeleton.n_joints, len(body.bones)
        return cls(
            MotionVAENetwork(settings, joints, bones),
            PoseNetwork(settings, joints, bones, body.n_groups),
        )


@dataclass(frozen=True, eq=False)
class ReadModel:
    """What :func:`read_model` finds in a checkpoint.

    Parameters
    ----------
    model : MotionVAEModel
        With its weights.
    settings : MotionVAESettings
        Its size.
    body : ArticulatedBody
        What moves.
    fps : float
        Frames per second.
    card : mapping
        What is known of its training.
    """

    model: MotionVAEModel
    settings: MotionVAESettings
    body: ArticulatedBody
    fps: float
    card: Mapping[str, Any]


def read_model(source: str | Path) -> ReadModel:
    """Return the networks of a checkpoint: a file, a run's folder or a name in the package.

    Raises
    ------
    CheckpointError
        If the file is damaged, of another version or no motion VAE.
    FileNotFoundError
        If there is no such file and no such name.
    """
    checkpoint = load_checkpoint(source, KIND)
    try:
        kept = checkpoint.settings["network"]
        settings = MotionVAESettings(**kept["size"])
        skeleton = Skeleton(kept["joint_names"], kept["parents"])
        body = ArticulatedBody(skeleton, np.array(kept["rest"], dtype=np.float64))
        model = MotionVAEModel.of(settings, body)
        fps = kept["fps"]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{source} has settings that are no motion VAE's: {error}") from error
    load_weights(model, checkpoint.tensors)
    return ReadModel(model, settings, body, fps, checkpoint.settings)


def description_of(size: MotionVAESettings, body: ArticulatedBody, fps: float) -> dict[str, Any]:
    """Return what a checkpoint says of a motion VAE, as JSON: :func:`read_model` reads it."""
    return {
        "size": asdict(size),
        "joint_names": list(body.skeleton.joint_names),
        "parents": list(body.skeleton.parents),
        "rest": body.rest.tolist(),
        "fps": fps,
    }

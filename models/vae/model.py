"""Motion VAE network and pose network as one model, with its checkpoint settings."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from probmotion.extras import nn
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.network import MotionVAENetwork
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings

__all__ = ["KIND", "MotionVAEModel", "description_of"]

KIND = "motion-vae"  # kind of the checkpoints


class MotionVAEModel(nn.Module):
    """Module with the motion VAE network and the pose network as parts."""

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


def description_of(size: MotionVAESettings, body: ArticulatedBody, fps: float) -> dict[str, Any]:
    """Return the checkpoint settings of a motion VAE, JSON-compatible."""
    return {
        "size": asdict(size),
        "joint_names": list(body.skeleton.joint_names),
        "parents": list(body.skeleton.parents),
        "rest": body.rest.tolist(),
        "fps": fps,
    }

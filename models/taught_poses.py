"""What a pose network says of the frames that it teaches with, asked once for each of them."""

from __future__ import annotations

import torch

from probmotion.models.motion_vae_layers import FRAMES_AT_ONCE
from probmotion.models.pose_network import PoseGuesses, PoseNetwork
from probmotion.models.track_batches import Batch, TrackBatches

__all__ = ["TaughtPoses"]


class TaughtPoses:
    """The poses of all frames of tracks, and of their mirror images, under every view.

    Frames do not look at each other and a teacher does not learn: what it says of a frame is the
    same in every window that shows it. Of a window that is scaled it says that the body is larger,
    and as much farther from the picture's centre. It takes some 3 kB for a frame of a person.

    Parameters
    ----------
    network : PoseNetwork
        The teacher, as it is now.
    batches : TrackBatches
        Whose frames; their augmentation has no shift.
    rest : Tensor, (J, 3)
        The rest pose, as for :meth:`PoseNetwork.forward`; the poses are where it is.

    Raises
    ------
    ValueError
        If the batches move their windows.
    """

    @torch.no_grad()
    def __init__(self, network: PoseNetwork, batches: TrackBatches, rest: torch.Tensor) -> None:
        if batches.augmentation.shift:
            raise ValueError(
                f"batches has shift={batches.augmentation.shift:g}, expected 0: windows that are "
                "moved have poses of their own"
            )
        keypoints, seen = (
            torch.as_tensor(values, device=rest.device) for values in batches.all_frames()
        )
        network.eval()
        # In full precision, whichever step asks first.
        with torch.autocast(rest.device.type, enabled=False):
            found = [
                network(some[:, None], looked_at[:, None].to(some.dtype), rest)
                for some, looked_at in zip(
                    keypoints.split(FRAMES_AT_ONCE), seen.split(FRAMES_AT_ONCE), strict=True
                )
            ]
        self._rotation = torch.cat([guesses.rotation[:, :, 0] for guesses in found])
        self._translation = torch.cat([guesses.translation[:, :, 0] for guesses in found])
        self._turns = torch.cat([guesses.turns[:, :, 0] for guesses in found])
        self._log_lengths = torch.cat([guesses.log_lengths for guesses in found])

    def of(self, drawn: Batch) -> PoseGuesses:
        """Return what the teacher says of windows that the batches have drawn."""
        device = self._turns.device
        frames = torch.as_tensor(drawn.frames, device=device)
        scale = torch.as_tensor(drawn.scale, device=device)[:, None, None]
        # Lengths are read from the mean of what frames say, linearly.
        lengths = self._log_lengths[frames].mean(dim=1) + scale.log()
        return PoseGuesses(
            self._rotation[frames].transpose(1, 2),
            scale[..., None] * self._translation[frames].transpose(1, 2),
            self._turns[frames].transpose(1, 2),
            lengths,
        )

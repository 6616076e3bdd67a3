"""What a pose network says of the frames that it teaches with, asked once for each of them."""

from __future__ import annotations

import torch

from probmotion.models.training.track_batches import Batch, TrackBatches
from probmotion.models.vae.layers import FRAMES_AT_ONCE
from probmotion.models.vae.pose_network import PoseGuesses, PoseNetwork

__all__ = ["TeacherForcedPoses", "scaled"]


class TeacherForcedPoses:
    """The poses of all frames of tracks, and of their mirror images, under every view.

    Frames do not look at each other and a teacher does not learn: what it says of a frame is the
    same in every window that shows it. A window that is scaled shows the same poses of a larger
    body, see :func:`scaled`. It takes some 3 kB for a frame of a person, and its mirror image's.

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
        """Return what the teacher says of windows that the batches have drawn, before scaling.

        Raises
        ------
        ValueError
            If a window is longer than its track.
        """
        if (drawn.frames < 0).any():
            raise ValueError("drawn has windows that are padded, expected frames of tracks only")
        frames = torch.as_tensor(drawn.frames, device=self._turns.device)
        return PoseGuesses(
            self._rotation[frames].transpose(1, 2),
            self._translation[frames].transpose(1, 2),
            self._turns[frames].transpose(1, 2),
            # Lengths are read from the mean of what frames say, linearly.
            self._log_lengths[frames].mean(dim=1),
        )


def scaled(guesses: PoseGuesses, scale: torch.Tensor) -> PoseGuesses:
    """Return poses whose pictures are larger: of a larger body, farther from the centre.

    Exactly so where rays are parallel. A camera at 7 m sees a joint that is half a metre nearer
    than the root, of a body a twentieth larger, 3 mm away from there.

    Parameters
    ----------
    guesses : PoseGuesses
        Of B windows.
    scale : Tensor, (B,)
        By which their pictures are scaled.
    """
    factor = scale.reshape(-1, *[1] * (guesses.translation.ndim - 1))
    longer = scale.log().reshape(-1, *[1] * (guesses.log_lengths.ndim - 1))
    return PoseGuesses(
        guesses.rotation,
        factor * guesses.translation,
        guesses.turns,
        guesses.log_lengths + longer,
    )

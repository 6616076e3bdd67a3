"""Base class of trained networks for 2D tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from probmotion.extras import nn
from probmotion.models.training.checkpoints import Checkpoint, load_checkpoint, valid_settings
from probmotion.models.training.devices import check_device
from probmotion.models.training.standardisation import Standards
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive, check_shape

__all__ = ["TrackNetwork", "load_track_checkpoint"]

Size = TypeVar("Size")


class TrackNetwork:
    """Base class of a trained network on standardised 2D data, with its training record ``card``.

    ``device`` is ``cpu``, ``cuda``, or ``auto``: ``cuda`` where it is available, else ``cpu``. On
    the CPU, batches have a fixed shape, so that results do not depend on the batch.

    Raises ``ValueError`` if shapes are inconsistent, ``fps`` is not positive or the device is not
    available.
    """

    def __init__(
        self,
        network: nn.Module,
        settings: Any,
        standards: Standards,
        skeleton: Skeleton,
        fps: float,
        *,
        device: str = "cpu",
        card: Mapping[str, Any] | None = None,
    ) -> None:
        check_shape("standards", standards.mean, (skeleton.n_joints, 2))
        check_positive("fps", fps)
        self.settings = settings
        self.standards = standards
        self.card = dict(card or {})
        self.skeleton = skeleton
        self.fps = float(fps)
        self._device = check_device(device).type
        self._network = network.to(self._device).eval().requires_grad_(False)


def load_track_checkpoint(
    source: str | Path, kind: str, size: type[Size]
) -> tuple[Checkpoint, Size, Standards, Skeleton, float]:
    """Return a checkpoint, its settings (a ``size``), standardisation, skeleton and frame rate."""
    checkpoint = load_checkpoint(source, kind)
    with valid_settings(source, kind):
        stored = checkpoint.settings["network"]
        settings = size(**stored["size"])
        skeleton = Skeleton(stored["joint_names"], stored["parents"])
        standards = Standards(np.array(stored["mean"]), np.array(stored["deviation"]))
        fps = float(stored["fps"])
    return checkpoint, settings, standards, skeleton, fps

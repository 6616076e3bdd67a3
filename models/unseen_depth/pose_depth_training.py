"""Training of the regression of depths on keypoints of videos whose motion is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.unseen_depth.pose_depth import (
    FRAMES,
    INPUTS,
    KEYPOINTS,
    PoseDepth,
    network_inputs,
)

__all__ = ["DepthExamples", "PoseDepthTrainee", "regression"]

_LAYERS, _DROPOUT = 3, 0.05
_SPREAD = 0.01  # weight of the errors' spread in the loss: it must not cost accuracy
_OCCLUDED = 0.3  # share of inputs of which joints are occluded for some time
_VALIDATED = 4096  # examples per batch of the validation


class DepthExamples(NamedTuple):
    """Keypoints of V videos at ``RATE``, with depths and pitches.

    ``inputs``: :func:`~probmotion.models.unseen_depth.pose_depth.relative_keypoints` of each video,
    (L, 3 J). ``targets``: depths of the joints behind the middle of the hips along the ray to the
    body, metres, and the pitch of the ray, radians, (L, J + 1).
    """

    inputs: Sequence[np.ndarray]
    targets: Sequence[np.ndarray]


class PoseDepthTrainee:
    """Trainee for :func:`~probmotion.models.training.trainer.train`.

    The loss is the mean absolute error, plus a small multiple of the negative log likelihood of the
    errors under Laplace distributions, of which only their scales are learnt. In a share of the
    inputs, some joints are occluded for some time: the scales of their errors are larger.

    Parameters
    ----------
    training, validation : DepthExamples
        Videos of different clips.
    width : int
        Width of the hidden layers.
    seed : int
        Seed of the initial weights.
    """

    kind = "pose-depth"

    def __init__(
        self, training: DepthExamples, validation: DepthExamples, width: int = 512, seed: int = 0
    ) -> None:
        self._data = [_joined(part) for part in (training, validation)]
        J = len(KEYPOINTS)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.network = _Network(INPUTS, width, 2 * J + 2)
        self.settings: Mapping[str, Any] = {
            "width": width,
            "videos": [len(training.inputs), len(validation.inputs)],
            "targets": [float(np.abs(targets).sum()) for _, targets, _ in self._data],
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of random frames."""
        data = self._data[0]
        rows = rng.integers(len(data.rows), size=batch)
        inputs = data.inputs[data.rows[rows]]
        return self._loss(network, _occluded(inputs, rng), data.targets[rows], device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss of all frames of the validation videos."""
        data, total = self._data[1], 0.0
        network.eval()
        with torch.no_grad():
            for start in range(0, len(data.rows), _VALIDATED):
                rows = slice(start, start + _VALIDATED)
                inputs, targets = data.inputs[data.rows[rows]], data.targets[rows]
                total += float(self._loss(network, inputs, targets, device)) * len(inputs)
        network.train()
        return total / len(data.rows)

    def _loss(
        self, network: nn.Module, inputs: np.ndarray, targets: np.ndarray, device: torch.device
    ) -> torch.Tensor:
        flat = network_inputs(inputs).astype(np.float32)
        mean, logs = network(torch.as_tensor(flat, device=device)).chunk(2, dim=1)
        error = (torch.as_tensor(targets, device=device) - mean).abs()
        likelihood = logs + error.detach() * torch.exp(-logs)
        return (error + _SPREAD * likelihood).mean()


def _occluded(inputs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return inputs (n, FRAMES, 3 J), a share of them with joints occluded for some time."""
    n, J = len(inputs), len(KEYPOINTS)
    ends = np.sort(rng.integers(FRAMES + 1, size=(n, 2)), axis=1)
    frames = np.arange(FRAMES)
    during = (frames >= ends[:, :1]) & (frames < ends[:, 1:])
    joints = rng.random((n, J)) < rng.random((n, 1))  # from few to all
    some = rng.random((n, 1, 1)) < _OCCLUDED
    shown = ~(some & during[:, :, None] & joints[:, None])
    return inputs * np.concatenate([np.repeat(shown, 2, axis=2), shown], axis=2)


class _Data(NamedTuple):
    """Frames (N, 3 J), targets (N, J + 1), and the frames of each input, (N, FRAMES)."""

    inputs: np.ndarray
    targets: np.ndarray
    rows: np.ndarray


def _joined(examples: DepthExamples) -> _Data:
    """Return the frames of all videos; inputs do not extend over a video's ends."""
    rows, start = [], 0
    window = np.arange(FRAMES) - FRAMES // 2
    for video in examples.inputs:
        own = np.clip(np.arange(len(video))[:, None] + window, 0, len(video) - 1)
        rows.append(start + own)
        start += len(video)
    inputs, targets = (np.concatenate(part).astype(np.float32) for part in examples)
    return _Data(inputs, targets, np.concatenate(rows))


class _Network(nn.Module):
    """Layers of :class:`~probmotion.models.unseen_depth.pose_depth.PoseDepth`, with dropout."""

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, width)
        self.residual = nn.ModuleList(nn.Linear(width, width) for _ in range(_LAYERS))
        self.last = nn.Linear(width, outputs)
        self.dropout = nn.Dropout(_DROPOUT)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        hidden = self.dropout(torch.relu(self.first(inputs)))
        for layer in self.residual:
            hidden = hidden + self.dropout(torch.relu(layer(hidden)))
        outputs: torch.Tensor = self.last(hidden)
        return outputs


def regression(tensors: Mapping[str, torch.Tensor], card: Mapping[str, Any]) -> PoseDepth:
    """Return the regression with the weights of a trained network."""
    names = [name.removesuffix(".weight") for name in tensors if name.endswith(".weight")]
    layers = [
        (tensors[f"{name}.weight"].double().numpy(), tensors[f"{name}.bias"].double().numpy())
        for name in ("first", *sorted(n for n in names if n.startswith("residual")), "last")
    ]
    return PoseDepth(layers, card)

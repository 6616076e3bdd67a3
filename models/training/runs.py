"""Functions to save and resume training runs."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from probmotion.extras import nn, torch
from probmotion.files import written_whole
from probmotion.models.training.checkpoints import (
    MODEL,
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from probmotion.models.training.settings import TrainingSettings

__all__ = ["LOSSES", "STATE", "Run", "check_same_run", "keep_run", "resume_run", "steps_taken"]

STATE, LOSSES = "state.safetensors", "losses.csv"
"""Names of the files for resuming and of the losses, in the folder of a run."""

_MAX_QUOTED = 200  # characters; error messages do not quote longer values


@dataclass(eq=False)
class Run:
    """State of a training run after ``step`` steps."""

    network: nn.Module
    average: nn.Module  # network with the moving average of the weights
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)  # rows of losses.csv
    recent: list[float] = field(default_factory=list)  # losses since the last row


def keep_run(
    run: Run, kind: str, described: dict[str, Any], folder: Path, *, model: bool = True
) -> None:
    """Write the model, the losses and, last, the state for resuming.

    If ``model`` is false, an existing model is not overwritten.
    """
    card = described | {"step": run.step, "seconds": run.seconds, "history": run.history}
    if model or not (folder / MODEL).exists():
        save_checkpoint(folder / MODEL, Checkpoint(kind, card, run.average.state_dict()))
    with (
        written_whole(folder / LOSSES) as path,
        open(path, "w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, ["step", "loss", "validation_loss", "seconds"])
        writer.writeheader()
        writer.writerows(run.history)
    tensors = {f"network.{name}": value for name, value in run.network.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in run.average.state_dict().items()}
    for number, moments in run.optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": value for name, value in moments.items()}
    state = card | {"recent": run.recent}
    save_checkpoint(folder / STATE, Checkpoint(_state_of(kind), state, tensors))


def steps_taken(folder: Path, kind: str) -> int:
    """Return the number of steps of the run in a folder, 0 without a run."""
    if (folder / STATE).exists():
        return int(load_checkpoint(folder / STATE, _state_of(kind)).settings["step"])
    return 0


def resume_run(run: Run, folder: Path, kind: str, described: dict[str, Any]) -> None:
    """Restore a run from its folder; restore a missing or damaged model from the state.

    Raises ``CheckpointError`` for a damaged state or another kind of network, and ``ValueError``
    for other settings or data.
    """
    saved = load_checkpoint(folder / STATE, _state_of(kind))
    check_same_run(saved.settings, described, folder)
    parts: defaultdict[str, dict[str, torch.Tensor]] = defaultdict(dict)
    for name, tensor in saved.tensors.items():
        part, _, rest = name.partition(".")
        parts[part][rest] = tensor
    run.network.load_state_dict(parts["network"])
    run.average.load_state_dict(parts["average"])
    moments: defaultdict[int, dict[str, torch.Tensor]] = defaultdict(dict)
    for name, tensor in parts["optimiser"].items():
        number, _, rest = name.partition(".")
        moments[int(number)][rest] = tensor
    groups = run.optimiser.state_dict()["param_groups"]
    run.optimiser.load_state_dict({"state": dict(moments), "param_groups": groups})
    run.step = int(saved.settings["step"])
    run.seconds = float(saved.settings["seconds"])
    run.history = list(saved.settings["history"])
    run.recent = list(saved.settings["recent"])
    try:
        load_checkpoint(folder / MODEL, kind)
    except (CheckpointError, FileNotFoundError):
        card = {name: value for name, value in saved.settings.items() if name != "recent"}
        save_checkpoint(folder / MODEL, Checkpoint(kind, card, parts["average"]))


def check_same_run(
    saved: Mapping[str, Any], described: Mapping[str, Mapping[str, Any]], folder: Path
) -> None:
    """Raise ``ValueError`` if saved and described settings that affect steps differ."""
    # A run without a setting was saved before its introduction and used its present default.
    defaults = {"network": {}, "training": json.loads(json.dumps(asdict(TrainingSettings())))}
    for part, settings in described.items():
        for name, expected in settings.items():
            got = saved[part].get(name, defaults[part].get(name))
            # These two settings do not affect the training steps.
            if got != expected and name not in ("steps", "checkpoint_every"):
                if len(f"{got}{expected}") > _MAX_QUOTED:
                    got, expected = "the same", "another"
                raise ValueError(
                    f"{name} must be {got} to resume {folder}, got {expected}; use another folder"
                )


def _state_of(kind: str) -> str:
    return f"{kind} in training"

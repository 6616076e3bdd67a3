"""What changes while a network is trained, and how it is kept so that a run can go on."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

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
"""Beside the model, in the folder of a run: what it goes on from, and its losses."""


_READABLE = 200


@dataclass(eq=False)
class Run:
    """Everything that changes from step to step."""

    network: nn.Module
    average: nn.Module
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)
    recent: list[float] = field(default_factory=list)


def keep_run(
    run: Run, kind: str, described: dict[str, Any], folder: Path, *, model: bool = True
) -> None:
    """Write the model, its losses and, last, the state to go on from.

    ``model`` false leaves the model that is there, if there is one.
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
    """Return how many steps the run in a folder has taken; 0 where there is none.

    Raises
    ------
    CheckpointError
        If the run is of another kind of network, or what it goes on from is damaged.
    """
    if (folder / STATE).exists():
        return int(load_checkpoint(folder / STATE, _state_of(kind)).settings["step"])
    return 0


def resume_run(run: Run, folder: Path, kind: str, described: dict[str, Any]) -> None:
    """Bring a run to where the one in the folder was stopped.

    The state holds all that the model does: where the model is missing or damaged it is written
    anew, as it was.

    Raises
    ------
    CheckpointError
        If the run is of another kind of network, or its state is damaged.
    ValueError
        If the run has other settings or data; nothing is written then.
    """
    kept = load_checkpoint(folder / STATE, _state_of(kind))
    check_same_run(kept.settings, described, folder)
    parts: dict[str, dict[str, torch.Tensor]] = {}
    for name, tensor in kept.tensors.items():
        part, _, rest = name.partition(".")
        parts.setdefault(part, {})[rest] = tensor
    run.network.load_state_dict(parts["network"])
    run.average.load_state_dict(parts["average"])
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in parts.get("optimiser", {}).items():
        number, _, rest = name.partition(".")
        moments.setdefault(int(number), {})[rest] = tensor
    held = run.optimiser.state_dict()
    run.optimiser.load_state_dict({"state": moments, "param_groups": held["param_groups"]})
    run.step = int(kept.settings["step"])
    run.seconds = float(kept.settings["seconds"])
    run.history = list(kept.settings["history"])
    run.recent = list(kept.settings["recent"])
    try:
        load_checkpoint(folder / MODEL, kind)
    except (CheckpointError, FileNotFoundError):
        card = {name: value for name, value in kept.settings.items() if name != "recent"}
        save_checkpoint(folder / MODEL, Checkpoint(kind, card, parts["average"]))


def check_same_run(
    kept: Mapping[str, Any], described: Mapping[str, Mapping[str, Any]], folder: Path
) -> None:
    """Raise ``ValueError`` unless the run in a folder is the one that is described.

    Parameters
    ----------
    kept : mapping
        Settings of its checkpoint.
    described : mapping of mapping
        What it should be: its parts ``network`` and ``training``, or one of them.
    folder : Path
        Where it is.
    """
    # A run that was kept before there was a setting ran with what is now the usual one.
    usual = {"network": {}, "training": json.loads(json.dumps(asdict(TrainingSettings())))}
    for part, settings in described.items():
        for name, wanted in settings.items():
            got = kept[part].get(name, usual[part].get(name))
            # Checkpoints may come more often and the end later: no step is changed by it.
            if got != wanted and name not in ("steps", "checkpoint_every"):
                known = f"{name} {got}, expected {wanted}"
                if len(known) > _READABLE:
                    known = f"another {name}, expected the same"
                raise ValueError(
                    f"out is {folder}, which holds a run with {known}; give it a folder of its own"
                )


def _state_of(kind: str) -> str:
    return f"{kind} in training"

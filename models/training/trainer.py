"""One trainer for every network: resumes exactly, keeps what it has, says when it diverges.

The batch and the noise of step k are addressed by (seed, k), never drawn from a running state, so
that a run which was stopped and goes on takes the same steps as one that was not.
"""

from __future__ import annotations

import copy
import math
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.training.checkpoints import MODEL
from probmotion.models.training.runs import STATE, Run, keep_run, resume_run
from probmotion.models.training.settings import TrainingSettings
from probmotion.posteriors.sampling import progress_bar

__all__ = [
    "Anneals",
    "Diverged",
    "Trainee",
    "TrainingResult",
    "check_device",
    "train",
]


class Diverged(ValueError):  # noqa: N818 (what happened, in a word)
    """A loss or gradient is not finite; the message names the last good checkpoint."""


class Trainee(Protocol):
    """A network, and what it learns from.

    ``kind`` names its checkpoints; ``settings`` is JSON that rebuilds it and says what it learnt
    from, so that a run cannot go on with other data.
    """

    kind: str
    network: nn.Module
    settings: Mapping[str, Any]

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of a fresh batch; all random numbers but dropout come from ``rng``."""

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on data that is not learnt from; the same call gives the same number."""


@runtime_checkable
class Anneals(Protocol):
    """A trainee whose loss changes over a run."""

    def anneal(self, step: int) -> None:
        """Be at a step, counted from 1; called before its loss is asked for."""


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """What a run left.

    Parameters
    ----------
    model : Path
        The network's checkpoint, with the moving average of the weights.
    history : list of dict
        Per checkpoint: step, loss (mean since the last), validation_loss, seconds.
    kept : dict
        The checkpoint's row whose weights the model has: with ``patience`` the one of the lowest
        validation loss, else the last.
    steps : int
        Steps that this call took: 0 where the run had ended before.
    """

    model: Path
    history: list[dict[str, float]]
    kept: dict[str, float]
    steps: int


def check_device(device: str) -> torch.device:
    """Return the device ``cpu`` or ``cuda``.

    Raises
    ------
    ValueError
        If it is another one, or there is no CUDA.
    """
    if device not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {device!r}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device is 'cuda', but this machine has no CUDA; expected 'cpu'")
    return torch.device(device)


def train(
    trainee: Trainee,
    settings: TrainingSettings,
    out: str | Path,
    *,
    device: str = "cpu",
    progress: bool = True,
) -> TrainingResult:
    """Train a network; the same call goes on where an earlier one was stopped.

    Networks compute in mixed precision (bfloat16) on CUDA, in single precision on the CPU.

    Parameters
    ----------
    trainee : Trainee
        The network and its data.
    settings : TrainingSettings
        How to train. A finished run goes on with more ``steps``, all else equal.
    out : str or Path
        Folder for ``model.safetensors``, ``state.safetensors`` (to go on from) and
        ``losses.csv``; made where it is missing. A model that is missing or damaged beside a
        state is written anew from it.
    device : str
        ``cpu`` or ``cuda``.
    progress : bool
        Show a bar with loss and speed.

    Raises
    ------
    Diverged
        If a loss or gradient is not finite; the last good checkpoint stays.
    ValueError
        If ``out`` holds a run with other settings or data, or the device is not there.
    KeyboardInterrupt
        At Ctrl-C or SIGTERM, once the step is finished and kept; the message says where.
    """
    place = check_device(device)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    run = _start(trainee, settings, place)
    described = {"network": dict(trainee.settings), "training": asdict(settings)}
    # As JSON gives them back.
    described["training"]["halve_at"] = list(settings.halve_at)
    if math.isinf(settings.clip):
        described["training"]["clip"] = None
    if (folder / STATE).exists():
        resume_run(run, folder, trainee.kind, described)
    with (
        _asked_to_stop() as stop,
        progress_bar(settings.steps, f"train {trainee.kind}", progress) as bar,
    ):
        before = run.step
        bar.update(min(before, settings.steps))
        while run.step < settings.steps and not _waited_enough(run, settings):
            begun = time.perf_counter()
            loss = _take_step(run, trainee, settings, place, folder)
            run.seconds += time.perf_counter() - begun
            run.recent.append(loss)
            bar.update(1)
            if progress and run.step % 20 == 0:
                bar.set_postfix(loss=f"{np.mean(run.recent[-100:]):.4f}", refresh=False)
            if run.step % settings.checkpoint_every == 0 or run.step == settings.steps:
                _validate(run, trainee, place, folder)
                best = settings.patience == 0 or _since_best(run) == 0
                keep_run(run, trainee.kind, described, folder, model=best)
            if stop():
                keep_run(run, trainee.kind, described, folder, model=settings.patience == 0)
                raise KeyboardInterrupt(
                    f"stopped at step {run.step} of {settings.steps}, which is kept in {folder}; "
                    "the same command goes on from there"
                )
    kept = run.history[-1 - _since_best(run)] if settings.patience else run.history[-1]
    return TrainingResult(folder / MODEL, run.history, kept, run.step - before)


def _start(trainee: Trainee, settings: TrainingSettings, device: torch.device) -> Run:
    network = trainee.network.to(device)
    average = copy.deepcopy(network).requires_grad_(False)
    kinds = {"adamw": partial(torch.optim.AdamW, fused=True), "adamax": torch.optim.Adamax}
    learnt = [weights for weights in network.parameters() if weights.requires_grad]
    optimiser = kinds[settings.optimiser](
        learnt, lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    return Run(network, average, optimiser)


def _take_step(
    run: Run, trainee: Trainee, settings: TrainingSettings, device: torch.device, folder: Path
) -> float:
    """Take one step and return its loss."""
    step = run.step + 1
    run.network.train()
    for group in run.optimiser.param_groups:
        group["lr"] = settings.rate(step)
    run.optimiser.zero_grad(set_to_none=True)
    with (
        _dropout_of(settings.seed, step, device),
        torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"),
    ):
        if isinstance(trainee, Anneals):
            trainee.anneal(step)
        rng = seeds.generator(settings.seed, "step", step)
        loss = trainee.training_loss(run.network, rng, settings.batch, device)
    loss.backward()
    size = nn.utils.clip_grad_norm_(run.network.parameters(), settings.clip)
    value = float(loss.detach())
    if not (math.isfinite(value) and math.isfinite(float(size))):
        what = f"the loss is {value:g}"
        if math.isfinite(value):
            what = "the gradient is not finite"
        raise Diverged(_diverged(step, what, folder))
    run.optimiser.step()
    decay = settings.decay(step) if settings.ema else 0.0
    with torch.no_grad():
        for kept, new in zip(run.average.parameters(), run.network.parameters(), strict=True):
            kept.lerp_(new, 1 - decay)
        for kept, new in zip(run.average.buffers(), run.network.buffers(), strict=True):
            kept.copy_(new)
    run.step = step
    return value


def _since_best(run: Run) -> int:
    """Return how many checkpoints ago the validation loss was lowest."""
    losses = [row["validation_loss"] for row in run.history]
    return len(losses) - 1 - int(np.argmin(losses))


def _waited_enough(run: Run, settings: TrainingSettings) -> bool:
    return 0 < settings.patience <= len(run.history) and _since_best(run) >= settings.patience


def _diverged(step: int, what: str, folder: Path) -> str:
    kept, where = "there is no checkpoint yet", ""
    if (folder / STATE).exists():
        # A folder holds a run of one rate.
        kept, where = f"the last good checkpoint is {folder / MODEL}", " in another folder"
    return f"training diverged at step {step}: {what}; {kept}; try a smaller learning_rate{where}"


def _validate(run: Run, trainee: Trainee, device: torch.device, folder: Path) -> None:
    run.average.eval()
    with torch.no_grad():
        loss = trainee.validation_loss(run.average, device)
    if not math.isfinite(loss):
        raise Diverged(_diverged(run.step, f"the validation loss is {loss:g}", folder))
    for network in (run.network, run.average):
        if not all(torch.isfinite(weights).all() for weights in network.parameters()):
            raise Diverged(_diverged(run.step, "a weight is not finite", folder))
    row = {"step": run.step, "loss": float(np.mean(run.recent)), "validation_loss": loss}
    run.history.append(row | {"seconds": run.seconds})
    run.recent.clear()


@contextmanager
def _dropout_of(seed: int, step: int, device: torch.device) -> Iterator[None]:
    """Dropout knows no generator but torch's own: lend it one of this step, and put it back."""
    devices = [torch.cuda.current_device()] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seeds.integer(seed, "dropout", step))
        yield


@contextmanager
def _asked_to_stop() -> Iterator[Any]:
    """Yield a function: whether Ctrl-C or SIGTERM came. A second one stops at once."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, frame: Any) -> None:
        if asked:
            raise KeyboardInterrupt("stopped within a step; the last checkpoint is kept")
        asked.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

"""Training loop of all networks, with exact resumption and detection of divergence.

Batch and noise of step k are derived from (seed, k) rather than from a running state, so a resumed
run takes the same steps as an uninterrupted one.
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

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.files import forget_killed, locked_folder, writable_folder
from probmotion.models.training.checkpoints import MODEL
from probmotion.models.training.devices import check_device, dropout_seed, half_precision
from probmotion.models.training.runs import STATE, Run, keep_run, resume_run
from probmotion.models.training.settings import TrainingSettings
from probmotion.posteriors.sampling import progress_bar

__all__ = ["Anneals", "Diverged", "Trainee", "TrainingResult", "train"]


class Diverged(ValueError):  # noqa: N818 (shorter than DivergenceError)
    """Error for a loss, gradient or weight that is not finite; names the last good checkpoint."""


class Trainee(Protocol):
    """Interface of a network with its loss and data.

    ``kind`` identifies its checkpoints. ``settings``, JSON-compatible, specifies the network and
    its data, so that a run cannot be resumed with other settings or data.
    """

    kind: str
    network: nn.Module
    settings: Mapping[str, Any]

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of a random batch; ``rng`` determines all randomness except dropout."""

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out data; deterministic."""


@runtime_checkable
class Anneals(Protocol):
    """Interface of a trainee whose loss changes during training."""

    def anneal(self, step: int) -> None:
        """Set the current step, counted from 1; called before each training loss."""


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """Result of a training run.

    Parameters
    ----------
    model : Path
        Checkpoint of the network, with the moving average of the weights.
    history : list of dict
        Per checkpoint: step, loss (mean since the previous one), validation_loss, seconds.
    saved : dict
        Entry of ``history`` for the saved weights: the lowest validation loss with ``patience``,
        otherwise the last.
    steps : int
        Number of steps taken by this call, 0 if the run was already finished.
    """

    model: Path
    history: list[dict[str, float]]
    saved: dict[str, float]
    steps: int


def train(
    trainee: Trainee,
    settings: TrainingSettings,
    out: str | Path,
    *,
    device: str = "auto",
    progress: bool = True,
) -> TrainingResult:
    """Train a network; repeat the call to resume an interrupted run.

    Networks compute in mixed precision (bfloat16) on CUDA and in single precision on the CPU.

    Parameters
    ----------
    trainee : Trainee
        Network, loss and data.
    settings : TrainingSettings
        Training settings. To extend a finished run, increase only ``steps``.
    out : str or Path
        Folder for ``model.safetensors``, ``state.safetensors`` (to resume from) and ``losses.csv``;
        created if missing. A missing or damaged model is restored from the state.
    device : str
        ``cpu``, ``cuda``, or ``auto``: ``cuda`` where it is available, else ``cpu``.
    progress : bool
        Whether to show a progress bar.

    Raises
    ------
    Diverged
        If a loss, gradient or weight is not finite; the last good checkpoint remains.
    ValueError
        If ``out`` contains a run with other settings or data, or another process trains in it, or
        the device is not available.
    OSError
        If ``out`` cannot be written to; the last checkpoint remains.
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, after finishing the current step and saving the run.
    """
    target = check_device(device)
    folder = writable_folder(Path(out))
    with locked_folder("out", folder):
        forget_killed(folder)
        return _trained(trainee, settings, folder, target, progress)


def _trained(
    trainee: Trainee, settings: TrainingSettings, folder: Path, target: torch.device, progress: bool
) -> TrainingResult:
    run = _start(trainee, settings, target)
    # JSON has neither tuples nor infinity.
    clip = None if math.isinf(settings.clip) else settings.clip
    training = asdict(settings) | {"halve_at": list(settings.halve_at), "clip": clip}
    record = {"network": dict(trainee.settings), "training": training}
    if (folder / STATE).exists():
        resume_run(run, folder, trainee.kind, record)
    with (
        _stop_requested() as stop,
        progress_bar(settings.steps, f"train {trainee.kind}", progress) as bar,
    ):
        before = run.step
        bar.update(min(before, settings.steps))
        while run.step < settings.steps and not _out_of_patience(run, settings):
            start = time.perf_counter()
            loss = _take_step(run, trainee, settings, target, folder)
            run.seconds += time.perf_counter() - start
            run.recent.append(loss)
            bar.update(1)
            if progress and run.step % 20 == 0:
                bar.set_postfix(loss=f"{np.mean(run.recent[-100:]):.4f}", refresh=False)
            if run.step % settings.checkpoint_every == 0 or run.step == settings.steps:
                _validate(run, trainee, target, folder)
                best = settings.patience == 0 or _since_best(run) == 0
                keep_run(run, trainee.kind, record, folder, model=best)
            if stop():
                keep_run(run, trainee.kind, record, folder, model=settings.patience == 0)
                raise KeyboardInterrupt(
                    f"stopped at step {run.step} of {settings.steps}, saved in {folder}; run the "
                    "same command to resume"
                )
    saved = run.history[-1 - _since_best(run)] if settings.patience else run.history[-1]
    return TrainingResult(folder / MODEL, run.history, saved, run.step - before)


def _start(trainee: Trainee, settings: TrainingSettings, device: torch.device) -> Run:
    network = trainee.network.to(device)
    average = copy.deepcopy(network).requires_grad_(False)
    optimisers = {"adamw": partial(torch.optim.AdamW, fused=True), "adamax": torch.optim.Adamax}
    trained = [weights for weights in network.parameters() if weights.requires_grad]
    optimiser = optimisers[settings.optimiser](
        trained, lr=settings.learning_rate, weight_decay=settings.weight_decay
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
        dropout_seed(settings.seed, step, device),
        half_precision(device, device.type == "cuda"),
    ):
        if isinstance(trainee, Anneals):
            trainee.anneal(step)
        rng = seeds.generator(settings.seed, "step", step)
        loss = trainee.training_loss(run.network, rng, settings.batch, device)
    loss.backward()
    norm = nn.utils.clip_grad_norm_(run.network.parameters(), settings.clip)
    value = float(loss.detach())
    if not (math.isfinite(value) and math.isfinite(float(norm))):
        problem = "the gradient is not finite" if math.isfinite(value) else f"the loss is {value:g}"
        raise _diverged(step, problem, folder)
    run.optimiser.step()
    decay = settings.decay(step) if settings.ema else 0.0
    with torch.no_grad():
        for mean, new in zip(run.average.parameters(), run.network.parameters(), strict=True):
            mean.lerp_(new, 1 - decay)
        for mean, new in zip(run.average.buffers(), run.network.buffers(), strict=True):
            mean.copy_(new)
    run.step = step
    return value


def _since_best(run: Run) -> int:
    """Return how many checkpoints ago the validation loss was lowest."""
    losses = [row["validation_loss"] for row in run.history]
    return len(losses) - 1 - int(np.argmin(losses))


def _out_of_patience(run: Run, settings: TrainingSettings) -> bool:
    return 0 < settings.patience <= len(run.history) and _since_best(run) >= settings.patience


def _diverged(step: int, problem: str, folder: Path) -> Diverged:
    last, where = "there is no checkpoint yet", ""
    if (folder / STATE).exists():
        # The learning rate of a stored run cannot be changed.
        last, where = f"the last good checkpoint is {folder / MODEL}", " in another folder"
    return Diverged(
        f"training diverged at step {step}: {problem}; {last}; try a smaller learning_rate{where}"
    )


def _validate(run: Run, trainee: Trainee, device: torch.device, folder: Path) -> None:
    run.average.eval()
    with torch.no_grad():
        loss = trainee.validation_loss(run.average, device)
    if not math.isfinite(loss):
        raise _diverged(run.step, f"the validation loss is {loss:g}", folder)
    for network in (run.network, run.average):
        if not all(torch.isfinite(weights).all() for weights in network.parameters()):
            raise _diverged(run.step, "a weight is not finite", folder)
    row = {"step": run.step, "loss": float(np.mean(run.recent)), "validation_loss": loss}
    run.history.append(row | {"seconds": run.seconds})
    run.recent.clear()


@contextmanager
def _stop_requested() -> Iterator[Any]:
    """Yield a function that returns whether Ctrl-C or SIGTERM arrived; raise on a second signal."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def handle(number: int, frame: Any) -> None:
        if received:
            raise KeyboardInterrupt("stopped during a step; the last checkpoint remains")
        received.append(number)

    handlers = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)

"""Options and functions shared by the training commands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from probmotion.models.training.settings import TrainingSettings

__all__ = ["Steps", "check_enough_clips", "check_out", "listed_clips", "run_training"]

_LISTED = 6  # maximum number of printed names


@dataclass(frozen=True)
class Steps:
    """Optimisation settings; defaults depend on the kind of network and its size."""

    steps: int | None = None
    """Number of gradient steps."""

    batch: int | None = None
    """Number of sequences or images per step."""

    learning_rate: float | None = None
    """Learning rate after a linear warm-up."""

    checkpoint_every: int = 500
    """Number of steps between checkpoints, each with a validation loss."""

    seed: int = 0
    """Seed of initial weights, batches and noise."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device; auto is cuda where it is available. On cuda, training is in mixed precision."""

    def settings(self, defaults: TrainingSettings) -> TrainingSettings:
        """Return the default settings ``defaults``, overridden by the given options."""
        from probmotion.models.training.devices import check_device

        check_device(self.device)  # early, since data preparation takes minutes
        given = {k: v for k, v in asdict(self).items() if v is not None and k != "device"}
        return replace(defaults, **given)


def check_out(out: Path) -> None:
    """Raise ``ValueError`` if the output folder or one of its parents is a file."""
    existing = next((path for path in (out, *out.parents) if path.exists()), out)
    if existing.is_file():
        raise ValueError(f"out must be a folder, got {out}; {existing} is a file")


def check_enough_clips(names: Iterable[str]) -> None:
    """Raise ``ValueError`` if there are too few clips for a random split."""
    clips = sorted(set(names))
    if len(clips) < 6:  # a tenth of 5 clips rounds to 0
        raise ValueError(
            f"clips must be at least 6 for a random split, got {len(clips)} ({', '.join(clips)}); "
            "name held-out clips with --validation and --test"
        )


def listed_clips(names: Sequence[str]) -> str:
    """Return the number of clips and the first 6 names, such as ``2 clips: walk0, walk1``."""
    more = ", …" if len(names) > _LISTED else ""
    return f"{len(names)} clip{'s' * (len(names) != 1)}: {', '.join(names[:_LISTED])}{more}"


def run_training(trainee: Any, settings: TrainingSettings, out: Path, device: str) -> None:
    """Start or resume the training of a network, and print the result."""
    from probmotion.models.training.checkpoints import MODEL, load_checkpoint
    from probmotion.models.training.runs import steps_taken
    from probmotion.models.training.trainer import train

    before = steps_taken(out, trainee.kind)
    if not before and (out / MODEL).exists():
        load_checkpoint(out / MODEL, trainee.kind)  # raises for another kind of network
    result = train(trainee, settings, out, device=device)
    last, saved = result.history[-1], result.saved
    ended = ""
    if last["step"] < settings.steps:
        ended = f"; stopped early at step {last['step']:.0f}: validation loss no longer decreases"
    if not result.steps:
        print(f"{result.model} is finished: {before} of {settings.steps} steps{ended}")
        return
    print(
        f"wrote {result.model}: step {saved['step']:.0f}, loss {saved['loss']:.4f}, validation "
        f"loss {saved['validation_loss']:.4f}, trained for {last['seconds']:.0f} s{ended}"
    )

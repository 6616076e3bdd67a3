"""What all commands of training share: how long to learn, where to, and the run itself.

The kinds are in :mod:`probmotion.cli.train` and :mod:`probmotion.cli.train_bodies`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from probmotion.models.training.settings import TrainingSettings

__all__ = ["Steps", "check_enough_clips", "check_out", "listed", "run_training"]

_LISTED = 6


@dataclass(frozen=True)
class Steps:
    """How long and how fast to learn; by default as the size was tried."""

    steps: int | None = None
    """Gradient steps."""

    batch: int | None = None
    """Sequences per step."""

    learning_rate: float | None = None
    """Of the optimiser, after a linear warm-up."""

    checkpoint_every: int = 500
    """Steps between two checkpoints, each with a validation loss."""

    seed: int = 0
    """Of the first weights, batches and noise."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute; mixed precision on cuda."""

    def settings(self, usual: TrainingSettings) -> TrainingSettings:
        """Return the usual settings of a size with what was asked for in their place."""
        from probmotion.models.training.trainer import check_device

        check_device(self.device)  # here, because preparing data takes minutes
        asked = {
            name: value
            for name, value in asdict(self).items()
            if value is not None and name != "device"
        }
        return replace(usual, **asked)


def check_out(out: Path) -> None:
    """Refuse at once a folder that could not be made after minutes of preparing data."""
    standing = next((place for place in (out, *out.parents) if place.exists()), out)
    if standing.is_file():
        where = "" if standing == out else f" below {standing}"
        raise ValueError(f"out is {out},{where} which is a file, expected a folder")


def check_enough_clips(names: Iterable[str]) -> None:
    """Refuse clips that are too few to be split by shares."""
    clips = sorted(set(names))
    # Fewer have no tenth: half a clip is rounded to none.
    if len(clips) < 6:
        raise ValueError(
            f"the number of clips is {len(clips)} ({', '.join(clips)}), too few to keep out a "
            "tenth twice, expected at least 6, or --validation NAME and --test NAME to say which "
            "are kept out"
        )


def listed(names: Sequence[str]) -> str:
    """Return the first names in words."""
    return ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")


def run_training(trainee: Any, settings: TrainingSettings, out: Path, device: str) -> None:
    """Train, or go on, and print how far it is."""
    from probmotion.models.training.checkpoints import MODEL, load_checkpoint
    from probmotion.models.training.runs import steps_taken
    from probmotion.models.training.trainer import train

    before = steps_taken(out, trainee.kind)
    if not before and (out / MODEL).exists():
        load_checkpoint(out / MODEL, trainee.kind)  # another network's is not written over
    result = train(trainee, settings, out, device=device)
    last, kept = result.history[-1], result.kept
    ended = ""
    if last["step"] < settings.steps:
        ended = f"; it ended at step {last['step']:.0f}, as the validation loss fell no more"
    if not result.steps:
        print(f"{result.model} is finished: it has taken {before} steps of {settings.steps}{ended}")
        return
    print(
        f"wrote {result.model}: step {kept['step']:.0f}, loss {kept['loss']:.4f}, validation loss "
        f"{kept['validation_loss']:.4f}, {last['seconds']:.0f} s of steps{ended}"
    )

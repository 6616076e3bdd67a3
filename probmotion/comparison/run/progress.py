"""Progress of a grid on standard error: a bar on a terminal, else a line per finished run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from probmotion.comparison.results.run_results import RunResult
from probmotion.comparison.run.grid_runs import GridRun
from probmotion.comparison.run.grid_tasks import GridTask

__all__ = ["reported"]


@contextmanager
def reported(
    tasks: Sequence[GridTask], label: str, show: bool
) -> Iterator[Callable[[GridTask], None]]:
    """Yield a function that reports one of ``tasks`` when it is finished.

    Without a terminal, all pilots share a single line.
    """
    if not show:
        yield lambda task: None
    elif sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(
            total=len(tasks),
            desc=label,
            leave=False,
            dynamic_ncols=True,
            mininterval=0,
            bar_format="{desc} {bar} {n_fmt}/{total_fmt}, about {remaining} left",
        ) as bar:

            def advance(task: GridTask) -> None:
                bar.set_description_str(f"{label}: {task.problem} {task.sampler}", refresh=False)
                bar.update()

            yield advance
    else:
        yield _lines(tasks, label)


def _lines(tasks: Sequence[GridTask], label: str) -> Callable[[GridTask], None]:
    start, total, done = time.monotonic(), len(tasks), 0
    if not isinstance(tasks[0], GridRun):
        _print(f"{total} {label} choose settings within the budget")
        return lambda task: None
    number = "seed" if label == "runs" else "simulation"

    def print_line(task: Any) -> None:
        nonlocal done
        done += 1
        remaining = (time.monotonic() - start) / done * (total - done)
        left = f", about {_rounded(remaining)} left" if done < total else ""
        run = f"{task.problem} {task.sampler} {number} {task.seed}"
        _print(f"[{done}/{total}] {run}: {_outcome(task.result())}{left}")

    return print_line


def _outcome(result: RunResult) -> str:
    if result.failure is not None:
        return f"{'unsupported' if result.failure.unsupported else 'failed'}, {result.failure.word}"
    # Simulations store ranks only.
    return f"{result.metrics['seconds']:.1f} s" if "seconds" in result.metrics else "done"


def _rounded(seconds: float) -> str:
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5970 else f"{seconds / 3600:.0f} h"


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)

"""Kill a grid at every file that it writes, continue it and report the outcome.

``python killed_runs.py FOLDER`` prints a line of JSON per kill. Grids run in forked processes, so
that libraries are loaded once.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
from pathlib import Path

import pandas as pd
from toy_samplers import Walking, count, generation, numbers

from probmotion.comparison import Budget, compare
from probmotion.comparison.results.run_results import read_draws, read_result

SMALL = {"draws": 10, "chains": 1, "workers": 0, "progress": False}


def run_grid(out: Path, diary: Path) -> None:
    """Run a pilot and two runs."""
    budget = Budget(evaluations=500)
    compare(generation(), Walking(diary=str(diary)), seeds=2, budget=budget, out=out, **SMALL)


def killed(out: Path, diary: Path, moment: int) -> str | None:
    """Run a grid in a child that SIGKILL ends at its ``moment``-th opening or renaming of a file.

    Its last file is truncated to half. Returns the prevented operation, or None if the child ended
    before.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        seen, last = 0, Path()

        def watch(event: str, arguments: tuple) -> None:
            nonlocal seen, last
            if event not in ("open", "os.rename") or isinstance(arguments[0], int):
                return
            path = Path(os.fsdecode(arguments[0]))
            if not path.is_relative_to(out):
                return
            if event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR):
                return
            seen += 1
            if seen == moment:
                if last.is_file():
                    os.truncate(last, last.stat().st_size // 2)
                os.write(writing, f"{event} {path.relative_to(out)}".encode())
                os.kill(os.getpid(), signal.SIGKILL)
            last = path

        sys.addaudithook(watch)
        run_grid(out, diary)
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8") as pipe:
        event = pipe.read()
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL), "a grid failed"
    return event if status else None


def runs(out: Path) -> list[Path]:
    """Return the folders of runs, complete or not."""
    return list(out.glob("runs/*/*/[0-9]"))


def is_complete(run: Path) -> bool:
    try:
        read_draws(run)
    except (OSError, ValueError):
        return False
    return read_result(run) is not None


def pilots(out: Path) -> list[Path]:
    return list(out.glob("pilots/*/[!.]*.json"))


def stamps(out: Path) -> dict[Path, tuple[int, int]]:
    """Return inode and time of every finished file."""
    finished = [file for run in runs(out) if is_complete(run) for file in [run, *run.iterdir()]]
    stats = {path: path.stat() for path in [*finished, *pilots(out)]}
    return {path: (stat.st_ino, stat.st_mtime_ns) for path, stat in stats.items()}


def table(out: Path) -> str:
    return numbers(pd.read_csv(out / "table.csv"))


def kill_everywhere(folder: Path) -> None:
    """Kill a grid at one moment after another, and print a line about each."""
    diary, complete = folder / "diary", folder / "complete"
    run_grid(complete, diary)
    n_runs = len(runs(complete))
    pilot_runs = count(diary) - n_runs
    for moment in range(1, 100):
        out = folder / f"{moment}"
        out.mkdir()
        event = killed(out, diary, moment)
        if event is None:
            return
        broken = [path for path in pilots(out) if not path.read_text().endswith("}\n")]
        broken += [run for run in runs(out) if not is_complete(run)]
        missing = n_runs - sum(map(is_complete, runs(out))) + (0 if pilots(out) else pilot_runs)
        before = stamps(out)
        diary.unlink(missing_ok=True)
        run_grid(out, diary)
        after = stamps(out)
        outcome = {
            "event": event,
            "broken": list(map(str, broken)),
            "changed": [str(path) for path in before if after.get(path) != before[path]],
            "missing": missing,
            "run": count(diary),
            "left": [str(path.relative_to(out)) for path in out.rglob("*unfinished*")],
            "same table": table(out) == table(complete),
        }
        print(json.dumps(outcome), flush=True)
        # Runs collect garbage, and the libraries' objects are permanent.
        gc.freeze()


kill_everywhere(Path(sys.argv[1]))

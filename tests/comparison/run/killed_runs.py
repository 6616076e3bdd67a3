"""Kill a grid at every file that it writes, continue it and report the outcome.

``python killed_runs.py FOLDER`` prints a line of JSON per kill. Grids run in forked processes, so
that libraries are loaded once.
"""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import pandas as pd
from toy_samplers import PriorDraws, Walking, count, generation, numbers

from probmotion.calibration import calibrate
from probmotion.comparison import Budget, compare
from probmotion.comparison.results.run_results import read_draws, read_result
from probmotion.posteriors.problem import simulated

SMALL = {"draws": 10, "chains": 1, "workers": 0, "progress": False}


def comparison(out: Path, diary: Path) -> None:
    """Run a pilot and two runs."""
    budget = Budget(evaluations=500)
    compare(generation(), Walking(diary=str(diary)), seeds=2, budget=budget, out=out, **SMALL)


def calibration(out: Path, diary: Path) -> None:
    """Run ten simulations."""
    sampler = PriorDraws(diary=str(diary))
    calibrate(simulated(generation()), sampler, simulations=10, out=out, **SMALL)


def killed(grid, out: Path, diary: Path, moment: int) -> str | None:
    """Run a grid in a child that SIGKILL ends at its ``moment``-th opening or renaming of a file.

    Its last file is cut to half, as after an earlier kill. Returns the operation that was
    prevented, or None if the child ended before.
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
        grid(out, diary)
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8") as pipe:
        event = pipe.read()
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL), "a grid failed"
    return event if status else None


def runs(out: Path) -> list[Path]:
    """Return the folders of runs, complete or not."""
    return list(out.glob("**/runs/*/*/[0-9]"))


def is_whole(run: Path) -> bool:
    """Whether a run's folder is complete."""
    if "calibration" not in run.parts:
        try:
            read_draws(run)
        except (OSError, ValueError):
            return False
    return read_result(run) is not None


def pilots(out: Path) -> list[Path]:
    return list(out.glob("pilots/*/[!.]*.json"))


def stamps(out: Path) -> dict[str, tuple[int, int]]:
    """Return inode and time of every finished file."""
    finished = [file for run in runs(out) if is_whole(run) for file in [run, *run.iterdir()]]
    return {
        str(path.relative_to(out)): (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in [*finished, *pilots(out)]
    }


def table(out: Path) -> str:
    (path,) = out.glob("**/table.csv")
    stored = pd.read_csv(path)
    return numbers(stored) if "metric" in stored else stored.to_csv(index=False)


def kill_everywhere(grid, folder: Path, first: int) -> None:
    """Kill a grid, of which the first runs are finished, at one moment after another."""
    diary, whole, beginning = folder / "diary", folder / "whole", folder / "beginning"
    grid(whole, diary)
    asked = len(runs(whole))
    pilot_runs = count(diary) - asked
    shutil.copytree(whole, beginning) if first else beginning.mkdir()
    for run in runs(beginning)[first:]:
        shutil.rmtree(run)
    for moment in range(1, 100):
        out = folder / f"{moment}"
        shutil.copytree(beginning, out)
        event = killed(grid, out, diary, moment)
        if event is None:
            return
        broken = [path for path in pilots(out) if not path.read_text().endswith("}")]
        broken += [run for run in runs(out) if not is_whole(run)]
        missing = asked - sum(map(is_whole, runs(out))) + (0 if pilots(out) else pilot_runs)
        before = stamps(out)
        diary.unlink(missing_ok=True)
        grid(out, diary)
        after = stamps(out)
        outcome = {
            "grid": grid.__name__,
            "event": event,
            "broken": list(map(str, broken)),
            "written again": [name for name, stamp in before.items() if after.get(name) != stamp],
            "missing": missing,
            "run": count(diary),
            "left": [str(path.relative_to(out)) for path in out.rglob("*unfinished*")],
            "same table": table(out) == table(whole),
        }
        print(json.dumps(outcome), flush=True)
        # Runs collect garbage, and the libraries' objects are permanent.
        gc.freeze()


def main(folder: Path) -> None:
    for grid, first in ((comparison, 0), (calibration, 8)):
        (folder / grid.__name__).mkdir()
        kill_everywhere(grid, folder / grid.__name__, first)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Kill a run at every file that it writes, let it go on, and say what became of it.

``python killed_runs.py FOLDER`` prints a line of JSON per kill. Runs are forked, so that libraries
are loaded once.
"""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
from toy_samplers import PriorDraws, Walking, generation

from probmotion.calibration import calibrate
from probmotion.comparison import Budget, compare
from probmotion.comparison.results.cell_results import read_draws, read_result
from probmotion.posteriors.problem import simulated

SMALL = {"draws": 10, "chains": 1, "workers": 0, "progress": False}
MEASURED = ["seconds", "peak_memory_mib"]


def comparison(out: Path, diary: Path) -> None:
    """A pilot and two cells."""
    budget = Budget(evaluations=500)
    compare(generation(), Walking(diary=str(diary)), seeds=2, budget=budget, out=out, **SMALL)


def calibration(out: Path, diary: Path) -> None:
    """Ten simulations."""
    sampler = PriorDraws(diary=str(diary))
    calibrate(simulated(generation()), sampler, simulations=10, out=out, **SMALL)


def killed(run: Callable[[], None], out: Path, moment: int) -> str | None:
    """Run in a child that SIGKILL ends as it opens or renames a file for the ``moment``-th time.

    What it wrote last is cut to half, as if it had been killed a little earlier. Return what it
    was about to do, or None if it ended before.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        count, last = 0, Path()

        def watch(event: str, arguments: tuple) -> None:
            nonlocal count, last
            if event not in ("open", "os.rename") or isinstance(arguments[0], int):
                return
            path = Path(os.fsdecode(arguments[0]))
            if not path.is_relative_to(out):
                return
            if event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR):
                return
            count += 1
            if count == moment:
                if last.is_file():
                    os.truncate(last, last.stat().st_size // 2)
                os.write(writing, f"{event} {path.relative_to(out)}".encode())
                os.kill(os.getpid(), signal.SIGKILL)
            last = path

        sys.addaudithook(watch)
        run()
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8") as told:
        event = told.read()
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL), "a run failed"
    return event if status else None


def cells(out: Path) -> list[Path]:
    """Return the folders of cells that are there, whole or not."""
    return list(out.glob("**/cells/*/*/[0-9]"))


def is_whole(cell: Path) -> bool:
    """Whether a cell's folder holds all that it should."""
    if "calibration" not in cell.parts:
        try:
            read_draws(cell)
        except (OSError, ValueError):
            return False
    return read_result(cell) is not None


def pilots(out: Path) -> list[Path]:
    """Return the files with what pilots found."""
    return list(out.glob("pilots/*/[!.]*.json"))


def broken(out: Path) -> list[str]:
    """Return what is there under its own name, and only half of it."""
    halves = [path for path in pilots(out) if not path.read_text().endswith("}")]
    halves += [cell for cell in cells(out) if not is_whole(cell)]
    return [str(path.relative_to(out)) for path in halves]


def stamps(out: Path) -> dict[str, tuple[int, int]]:
    """Return by finished file what tells whether it was written again."""
    finished = [file for cell in cells(out) if is_whole(cell) for file in [cell, *cell.iterdir()]]
    return {
        str(path.relative_to(out)): (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in [*finished, *pilots(out)]
    }


def table(out: Path) -> str:
    """Return the final table, but for what a clock says."""
    (path,) = out.glob("**/table.csv")
    held = pd.read_csv(path)
    if "metric" in held:
        held = held[~held["metric"].isin(MEASURED)]
    return held.to_csv(index=False)


def runs(diary: Path) -> int:
    """Return how often the sampler ran, and forget it."""
    counted = len(diary.read_text().split()) if diary.exists() else 0
    diary.unlink(missing_ok=True)
    return counted


def kills(run: Callable[[Path, Path], None], folder: Path, begun: int) -> Iterator[dict]:
    """Kill at one moment after the other, until a run ends before.

    ``begun`` is the number of cells that are there from the first.
    """
    diary, whole, start = folder / "diary", folder / "whole", folder / "start"
    run(whole, diary)
    asked = len(cells(whole))
    of_a_pilot = runs(diary) - asked
    if begun:
        shutil.copytree(whole, start)
        for cell in cells(start)[begun:]:
            shutil.rmtree(cell)
    for moment in range(1, 100):
        out = folder / f"{moment}"
        if begun:
            shutil.copytree(start, out)
        event = killed(lambda out=out: run(out, diary), out, moment)
        if event is None:
            return
        halves = broken(out)
        missing = asked - sum(map(is_whole, cells(out)))
        missing += of_a_pilot if not pilots(out) else 0
        kept = stamps(out)
        runs(diary)
        run(out, diary)
        after = stamps(out)
        yield {
            "run": run.__name__,
            "event": event,
            "broken": halves,
            "written again": [name for name, stamp in kept.items() if after.get(name) != stamp],
            "missing": missing,
            "runs": runs(diary),
            "left": [str(path.relative_to(out)) for path in out.rglob("*unfinished*")],
            "same table": table(out) == table(whole),
        }


def main(folder: Path) -> None:
    for run, begun in ((comparison, 0), (calibration, 8)):
        (folder / run.__name__).mkdir()
        for found in kills(run, folder / run.__name__, begun):
            print(json.dumps(found), flush=True)
            # Cells collect garbage; what is there by now is libraries'.
            gc.freeze()


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""Every sampler on every problem: the table that ``probmotion which`` and the README advise from.

    python notebooks/which_sampler.py --out grid    # resumes; two cores: 8 minutes and 4 a seed

Every sampler may spend as many seconds on a cell, by :data:`~probmotion.comparison.QUICK_BUDGET`;
one that cannot is a row that says so. Problems whose data is not at hand are left out, and said.
Beside the comparison's own files and its page, ``measured.csv`` and ``measured.json`` are written
to ``probmotion/advice`` and the README's table is replaced.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from readme_figures import replace_block

from probmotion.advice import Advice, Standing, advise, keep_measured
from probmotion.comparison import QUICK_BUDGET, QUICK_LIMIT, compare, quick_samplers
from probmotion.problems import load_problem, problem_names

ROOT = Path(__file__).parents[1]
DRAWS = 40


def main() -> None:
    """Run the grid and write what it found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("grid"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    problems = at_hand()
    start = time.perf_counter()
    found = compare(
        problems,
        quick_samplers(),
        draws=DRAWS,
        chains=4,
        seeds=asked.seeds,
        out=asked.out,
        workers=asked.workers,
        budget=QUICK_BUDGET,
        time_limit=QUICK_LIMIT,
    )
    print(f"grid_minutes: {(time.perf_counter() - start) / 60:.1f}")
    print(f"grid_cells: {len(found.results)}")
    print(found.table())
    found.report(asked.out / "report.html")
    keep_measured(found, "python notebooks/which_sampler.py")
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    text = replace_block(text, "which", "\n".join(table_of(map(advise, problems))))
    readme.write_text(text, encoding="utf-8")


def table_of(advices: Iterable[Advice]) -> Iterator[str]:
    """Yield the lines of the README's table."""
    yield "| problem | by | take | as good | not told from it, doubtful | worse | without draws |"
    yield "|---|---|---|---|---|---|---|"
    for each in advices:
        without = ", ".join(f"`{name}`: {word}" for name, word in each.without.items())
        cells = [
            f"`{each.problem}`",
            each.measure.partition(",")[0],
            in_brief([each.take])
            + f", {each.take.seconds:.2g} s"
            + (" – not right yet" if each.take.warnings else ""),
            in_brief(each.alike),
            in_brief(each.doubtful),
            in_brief(each.worse),
            without,
        ]
        yield f"| {' | '.join(cells)} |"


def in_brief(standings: Sequence[Standing]) -> str:
    """Return samplers with their means and deviations."""
    return ", ".join(
        f"`{each.sampler}` {each.value:.3g}"
        + (f" ± {each.spread:.1g}" if math.isfinite(each.spread) else "")
        for each in standings
    )


def at_hand() -> list[str]:
    """Return the names of the problems that can be made here, and say which cannot."""
    found = []
    for name in problem_names():
        try:
            load_problem(name)
        except FileNotFoundError as error:
            print(f"left out: {name}: {error}")
        else:
            found.append(name)
    return found


if __name__ == "__main__":
    main()

"""Write the tables of "which sampler?" in the documentation and the README.

probmotion compare all --quick --draws 40 --workers 2 --seeds 5 --out grid --report
python notebooks/which_sampler.py --grid grid    # store its measurements, then write the tables
python benchmarks/accuracy.py mixing             # store runs with larger budgets
python notebooks/which_sampler.py                # write the tables from stored measurements
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from probmotion import Comparison
from probmotion.comparison import advise
from probmotion.comparison.advice import Advice, Standing
from probmotion.comparison.measurements import LongerRun, measured, save_measurements

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "which-sampler.md")
SHOWN = ("gait", "gait-monocular", "gait-sparse", "cmu-monocular")
WHEN = {
    "exact": "posteriors in closed form, or no observations",
    "ensemble": "log density of at most about 20 dimensions, modes not far apart",
    "nuts": "log density with a gradient; start many chains and check R-hat",
    "mh": "log density without a gradient; start many chains and check R-hat",
    "tempered": "log density with modes far apart, and a prior that can be sampled",
    "smc": "the same; its evidence is estimated too",
    "ancestral3d": "3D denoiser",
    "split-gibbs": "observations and an exact 3D denoiser; on gaits, 2D too",
    "mvpc": "2D denoiser without observations",
    "mas": "comparison with the published method; `mvpc` costs the same",
    "dvae": "priors with an inference network; otherwise it trains one first",
    "sds": "one plausible motion; it does not sample",
}
"""Use of each sampler, from exact to no sampling at all."""


def main() -> None:
    """Rewrite the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--grid", type=Path, help="Folder of a finished comparison to store.")
    grid = parser.parse_args().grid
    if grid is not None:
        comparison = Comparison.load(grid)
        options = f"--draws {comparison.plan.draws} --workers 2 --seeds {comparison.plan.seeds}"
        command = f"probmotion compare all --quick {options}"
        save_measurements(comparison, command)
    advices = {name: advise(name) for name in dict.fromkeys(measured().rows["problem"])}
    tables = {
        "advice": "\n".join(advice_table(advices)),
        "problems": "\n".join(problem_table(advices.values())),
        "longer": "\n".join(longer_table(measured().longer)),
        "without": "\n".join(without_table(advices.values())),
    }
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name, table in tables.items():
            if f"<!-- {name}:" in text:
                text = replace_block(text, name, table)
        page.write_text(text, encoding="utf-8")


def replace_block(text: str, name: str, block: str) -> str:
    """Return a page with the block between two comments replaced."""
    pattern = rf"(<!-- {name}:.*?-->\n).*?(<!-- end of {name} -->)"
    changed, count = re.subn(pattern, lambda m: m[1] + block + "\n" + m[2], text, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"the page must contain one block called {name!r}, got {count}")
    return changed


def problem_table(advices: Iterable[Advice]) -> Iterator[str]:
    """Yield the table of all problems."""
    yield "| Problem | Metric | Recommended | On par | On par, with warnings | Worse |"
    yield "|---|---|---|---|---|---|"
    for each in advices:
        warned = " (with warnings)" if each.recommended.warnings else ""
        cells = [
            f"`{each.problem}`",
            each.metric.partition(",")[0],
            f"{in_brief([each.recommended])}, {each.recommended.seconds:.2g} s{warned}",
            in_brief(each.tied),
            in_brief(each.tied_with_warnings),
            in_brief(each.worse),
        ]
        yield f"| {' | '.join(cells)} |"


def longer_table(runs: Iterable[LongerRun]) -> Iterator[str]:
    """Yield the table of runs with larger budgets."""
    yield "| Problem | Sampler | Budget of a run | `swd_ratio` | Right |"
    yield "|---|---|---|---|---|"
    for run in runs:
        right = "yes" if run.right else "no"
        cells = f"`{run.problem}` | `{run.sampler}` | {run.seconds:g} s | {run.swd_ratio:.2f}"
        yield f"| {cells} | {right} |"


def without_table(advices: Iterable[Advice]) -> Iterator[str]:
    """Yield the table of samplers without draws."""
    yield "| Problem | Samplers without draws (reason) |"
    yield "|---|---|"
    for each in advices:
        if each.without_draws:
            listed = ", ".join(f"`{name}` ({word})" for name, word in each.without_draws.items())
            yield f"| `{each.problem}` | {listed} |"


def in_brief(standings: Sequence[Standing]) -> str:
    """Return samplers with their means and standard deviations."""
    return ", ".join(
        f"`{each.sampler}` {rounded(each.value, 3)}"
        + (f" ± {rounded(each.spread, 1)}" if math.isfinite(each.spread) else "")
        for each in standings
    )


def rounded(value: float, digits: int) -> str:
    """Return a number with ``digits`` significant digits, without an exponent."""
    return f"{float(f'{value:.{digits}g}'):g}"


def advice_table(advices: Mapping[str, Advice]) -> Iterator[str]:
    """Yield the table of samplers and their uses."""
    yield f"| Sampler | Use for | {' | '.join(f'`{name}`' for name in SHOWN)} |"
    yield "|---" * (2 + len(SHOWN)) + "|"
    results = {name: {s: result(advices[name], s) for s in WHEN} for name in SHOWN}
    best = {name: advices[name].recommended.sampler for name in SHOWN}
    for sampler, when in WHEN.items():
        cells = [
            f"**{results[name][sampler]}**" if best[name] == sampler else results[name][sampler]
            for name in SHOWN
        ]
        yield f"| `{sampler}` | {when} | {' | '.join(cells)} |"


def result(advice: Advice, sampler: str) -> str:
    """Return a sampler's mean on a problem, or why it has none."""
    for each in (advice.recommended, *advice.tied, *advice.tied_with_warnings, *advice.worse):
        if each.sampler == sampler:
            return f"{each.value:.2f}"
    return advice.without_draws[sampler]


if __name__ == "__main__":
    main()

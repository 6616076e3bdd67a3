"""The tables that ``probmotion which`` and the README advise from, of the whole grid.

    probmotion compare all --quick --workers 2 --seeds 5 --out grid --report
    python notebooks/which_sampler.py              # reads grid/

It writes ``measured.csv`` and ``measured.json`` to ``probmotion/advice`` and the README's tables.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from readme_figures import replace_block

from probmotion import Comparison
from probmotion.comparison import advise
from probmotion.comparison.advice import Advice, Standing
from probmotion.comparison.measurements import save_measurements

ROOT = Path(__file__).parents[1]
SHOWN = ("gait", "gait-monocular", "gait-sparse", "cmu-monocular")
WHEN = {
    "exact": "prior and evidence have a closed form, or there is no evidence and a prior that can "
    "be drawn from: nothing else is needed",
    "ensemble": "there is a log density of at most about 20 dimensions, and modes are not far "
    "apart",
    "nuts": "there is a log density with a gradient; start many chains, and look at R-hat: chains "
    "that began in different modes stay there",
    "mh": "there is a log density without a gradient; the same warning",
    "ancestral3d": "there is a 3D denoiser",
    "mvpc": "there is a 2D denoiser only",
    "mas": "to compare with the published method; `mvpc` costs the same",
    "dvae": "a network that reads the evidence comes with the prior; else it trains one first",
    "sds": "one plausible motion is enough: it does not sample",
}
"""When to take which sampler, from what is right of itself to what does not sample."""


def main() -> None:
    """Rewrite what was measured."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    found = Comparison.load(ROOT / "grid")
    save_measurements(
        found, f"probmotion compare all --quick --workers 2 --seeds {found.plan.seeds}"
    )
    advices = {name: advise(name) for name in found.plan.problems}
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    text = replace_block(text, "which", "\n".join(table_of(advices.values())))
    text = replace_block(text, "advice", "\n".join(when_table(advices)))
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


def when_table(advices: Mapping[str, Advice]) -> Iterator[str]:
    """Yield the lines of the table that says when to take which sampler."""
    yield f"| take | when | {' | '.join(f'`{name}`' for name in SHOWN)} |"
    yield "|---" * (2 + len(SHOWN)) + "|"
    for sampler, when in WHEN.items():
        cells = [how_far(advices[name], sampler) for name in SHOWN]
        yield f"| `{sampler}` | {when} | {' | '.join(cells)} |"


def how_far(advice: Advice, sampler: str) -> str:
    """Return a sampler's mean on a problem, or why it has none."""
    for each in (advice.take, *advice.alike, *advice.doubtful, *advice.worse):
        if each.sampler == sampler:
            return f"{each.value:.3g}"
    return advice.without[sampler]


if __name__ == "__main__":
    main()

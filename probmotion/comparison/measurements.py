"""The measurements that come with the package: every sampler on every problem, once.

``measured.csv`` holds the rows of a comparison's table that advice is made of, ``measured.json``
how they were measured, what each problem is and why some samplers have no numbers on it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from probmotion.comparison.results.qualities import QUALITIES
from probmotion.files import written_whole
from probmotion.metrics.chains import rhat_of_independent

if TYPE_CHECKING:
    import pandas as pd

    from probmotion.comparison.comparison import Comparison

__all__ = ["Measured", "measured", "save_measurements"]

_FOLDER = Path(__file__).parent
_ROWS, _ABOUT = "measured.csv", "measured.json"
_KEPT = (
    *QUALITIES,
    "seconds",
    "variance_ratio",
    "off_manifold_ratio",
    "mode_proportions_tv",
    "c2st",
    "rhat",
)
_DIGITS = 5


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured.

    Parameters
    ----------
    rows : DataFrame
        Columns problem, sampler, seed, metric, value.
    command : str
        What measured it.
    draws, seeds : int
        Draws of a cell, and independent repeats.
    rhat_at_most : float
        What the R-hat of so many draws is for chains that have mixed, 95 times in 100.
    notes : list of str
        What every sampler could spend.
    problems : dict of str
        By name, what it is.
    samplers : list of str
        Their names.
    words : dict of str
        By ``problem/sampler``: why one has no numbers, in a word.
    """

    rows: pd.DataFrame
    command: str
    draws: int
    seeds: int
    rhat_at_most: float
    notes: list[str]
    problems: dict[str, str]
    samplers: list[str]
    words: dict[str, str]


def save_measurements(comparison: Comparison, command: str, folder: str | Path = _FOLDER) -> None:
    """Write what advice needs of a comparison; by default in the place of what is shipped.

    Parameters
    ----------
    comparison : Comparison
        Of every sampler on every problem.
    command : str
        What made it.
    folder : str or Path
        Where ``measured.csv`` and ``measured.json`` go.
    """
    table = comparison.table()
    rows = table[table["metric"].isin(_KEPT)].copy()
    rows["value"] = [float(f"{value:.{_DIGITS}g}") for value in rows["value"]]
    plan, folder = comparison.plan, Path(folder)
    about = Measured(
        rows.iloc[:0],
        command,
        plan.draws,
        plan.seeds,
        rhat_of_independent(plan.chains, plan.draws // plan.chains),
        list(plan.notes),
        dict(plan.problems),
        list(plan.samplers),
        table.attrs["words"],
    )
    told = {name: value for name, value in vars(about).items() if name != "rows"}
    with written_whole(folder / _ROWS) as unfinished:
        rows.to_csv(unfinished, index=False)
    with written_whole(folder / _ABOUT) as unfinished:
        unfinished.write_text(json.dumps(told, indent=1, ensure_ascii=False), encoding="utf-8")


@cache
def measured(folder: str | Path = _FOLDER) -> Measured:
    """Return what was measured; by default what comes with the package."""
    import pandas as pd

    told = json.loads((Path(folder) / _ABOUT).read_text(encoding="utf-8"))
    return Measured(pd.read_csv(Path(folder) / _ROWS), **told)

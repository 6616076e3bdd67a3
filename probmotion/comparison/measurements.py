"""Measurements of every sampler on every problem, shipped with the package.

``measured.csv`` contains the metrics that ``advise`` uses, ``measured.json`` the settings,
problem descriptions and reasons for missing values, and ``longer.csv`` results with larger budgets.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from probmotion.comparison.results.headline_metrics import HEADLINE_METRICS
from probmotion.files import written_whole
from probmotion.metrics.chains import rhat_of_independent

if TYPE_CHECKING:
    import pandas as pd

    from probmotion.comparison.grid import Comparison

__all__ = ["LongerRun", "Measured", "measured", "save_longer", "save_measurements"]

_FOLDER = Path(__file__).parent
_ROWS, _SETTINGS, _LONGER = "measured.csv", "measured.json", "longer.csv"
_STORED_METRICS = (
    *HEADLINE_METRICS,
    "seconds",
    "variance_ratio",
    "off_manifold_ratio",
    "mode_proportions_tv",
    "c2st",
    "rhat",
)
_DIGITS = 5  # significant digits of stored values


class LongerRun(NamedTuple):
    """Result of a sampler with a larger budget.

    ``seconds`` is the budget of a run, ``swd_ratio`` the mean over seeds, and ``right`` whether the
    verdict on all seeds is "right".
    """

    problem: str
    sampler: str
    seconds: float
    swd_ratio: float
    right: bool

    def __str__(self) -> str:
        return f"{self.sampler}, {self.seconds:g} s per run, swd ratio {self.swd_ratio:.3g}"


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of samplers on problems.

    Parameters
    ----------
    rows : DataFrame
        Columns problem, sampler, seed, metric, value.
    command : str
        Command that produced the measurements.
    draws, seeds : int
        Number of draws per run, and number of replicates.
    rhat_at_most : float
        95 % quantile of R-hat for ``draws`` independent draws.
    notes : list of str
        Notes on the budget.
    problems : dict of str
        Problem descriptions by name.
    samplers : list of str
        Sampler names.
    words : dict of str
        One-word reason for missing draws, by ``problem/sampler``.
    longer : tuple of LongerRun
        Results with larger budgets.
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
    longer: tuple[LongerRun, ...] = ()


def save_measurements(comparison: Comparison, command: str, folder: str | Path = _FOLDER) -> None:
    """Write the measurements of a comparison and the command that produced it.

    By default the shipped files ``measured.csv`` and ``measured.json`` are replaced.
    """
    table = comparison.table()
    rows = table[table["metric"].isin(_STORED_METRICS)].copy()
    rows["value"] = [float(f"{value:.{_DIGITS}g}") for value in rows["value"]]
    plan, folder = comparison.plan, Path(folder)
    settings = {
        "command": command,
        "draws": plan.draws,
        "seeds": plan.seeds,
        "rhat_at_most": rhat_of_independent(plan.chains, plan.draws // plan.chains),
        "notes": list(plan.notes),
        "problems": dict(plan.problems),
        "samplers": list(plan.samplers),
        "words": table.attrs["words"],
    }
    with written_whole(folder / _ROWS) as unfinished:
        rows.to_csv(unfinished, index=False)
    with written_whole(folder / _SETTINGS) as unfinished:
        unfinished.write_text(json.dumps(settings, indent=1, ensure_ascii=False), encoding="utf-8")


def save_longer(runs: Sequence[LongerRun], folder: str | Path = _FOLDER) -> None:
    """Write results with larger budgets, by default to the shipped file ``longer.csv``."""
    import pandas as pd

    table = pd.DataFrame(runs, columns=list(LongerRun._fields))
    table["swd_ratio"] = [float(f"{value:.{_DIGITS}g}") for value in table["swd_ratio"]]
    with written_whole(Path(folder) / _LONGER) as unfinished:
        table.to_csv(unfinished, index=False)


@cache
def measured(folder: str | Path = _FOLDER) -> Measured:
    """Return the measurements in a folder, by default the shipped measurements."""
    import pandas as pd

    settings = json.loads((Path(folder) / _SETTINGS).read_text(encoding="utf-8"))
    longer: tuple[LongerRun, ...] = ()
    if (path := Path(folder) / _LONGER).exists():
        longer = tuple(map(LongerRun._make, pd.read_csv(path).itertuples(index=False)))
    return Measured(pd.read_csv(Path(folder) / _ROWS), **settings, longer=longer)

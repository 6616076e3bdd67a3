"""Errors of samplers of many modes within budgets, for ``accuracy.py mixing``."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from probmotion import compare
from probmotion.comparison import Budget
from probmotion.samplers import ParallelTempering, SequentialMonteCarlo

SEEDS, DRAWS, CHAINS = 3, 200, 4
TEMPERED = {"tempered": ParallelTempering()}
BOTH = {**TEMPERED, "smc": SequentialMonteCarlo()}
ROWS = (
    ("cmu_monocular_tempered_swd", "cmu-monocular", 6.0, TEMPERED),
    ("gait_noisy3d_best_swd_30s", "gait-noisy3d", 30.0, BOTH),
    ("walk_vae_monocular_best_swd_60s", "walk-vae-monocular", 60.0, BOTH),
)
"""Name, problem, seconds per run, and samplers."""


def mixing_figures() -> Iterator[tuple[str, float]]:
    """Yield the smallest ``swd_ratio`` of the samplers, each a mean over seeds.

    It is infinite if no sampler finishes all seeds within the budget.
    """
    options = {"draws": DRAWS, "chains": CHAINS, "seeds": SEEDS, "workers": 2, "progress": False}
    for name, problem, seconds, samplers in ROWS:
        budget = Budget(seconds=seconds)
        table = compare(problem, samplers, budget=budget, **options).table()  # type: ignore[arg-type]
        groups = table[table["metric"] == "swd_ratio"].groupby("sampler")["value"]
        ratios = groups.mean()[groups.count() == SEEDS]
        yield name, float(ratios.min()) if len(ratios) else np.inf

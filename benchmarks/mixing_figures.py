"""Errors of samplers of many modes within budgets, for ``accuracy.py mixing``.

``…_swd…``: the smallest mean ``swd_ratio``; of that sampler, ``…_mode_proportions_tv`` and
``…_rhat``: the largest over seeds, where there are modes. ``problems_without_a_right_sampler``:
problems with exact draws or a reference on which the sampler that ``probmotion which`` recommends
after 6 s has warnings, and no sampler here is right. Results of longer runs are stored in the
package: in place of such a sampler, that command names the cheapest that is right.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from probmotion import compare
from probmotion.comparison import Budget, advise
from probmotion.comparison.measurements import LongerRun, measured, save_longer
from probmotion.posteriors.sampling import Sampler
from probmotion.samplers import ParallelTempering, SequentialMonteCarlo, TemperedPairs

DRAWS = 200
TEMPERED = {"tempered": ParallelTempering()}
BOTH = {**TEMPERED, "smc": SequentialMonteCarlo()}
PAIRS = {"tempered-pairs": TemperedPairs()}
ROWS: tuple[tuple[str, str, float, int, int, Mapping[str, Sampler]], ...] = (
    ("cmu_monocular_tempered_swd", "cmu-monocular", 6.0, 4, 3, TEMPERED),
    ("gait_noisy3d_best_swd_30s", "gait-noisy3d", 30.0, 4, 3, BOTH),
    ("walk_vae_monocular_best_swd_60s", "walk-vae-monocular", 60.0, 4, 3, BOTH),
    # Runs have one core: 60 s are 30 s of two cores, too short for more than one chain. Short
    # runs differ, so that means need more seeds.
    ("salsa_pairs_swd_6s", "salsa-pairs", 12.0, 1, 12, PAIRS),
    ("salsa_pairs_swd_30s", "salsa-pairs", 60.0, 1, 8, PAIRS),
    ("salsa_pairs_swd_120s", "salsa-pairs", 240.0, 4, 3, PAIRS),
    ("salsa_pairs_swd_300s", "salsa-pairs", 600.0, 4, 3, PAIRS),
    ("dance_pairs_swd_6s", "dance-pairs", 12.0, 1, 12, PAIRS),
    ("dance_pairs_swd_30s", "dance-pairs", 60.0, 1, 8, PAIRS),
    ("dance_pairs_swd_120s", "dance-pairs", 240.0, 4, 8, PAIRS),
    ("dance_pairs_swd_300s", "dance-pairs", 600.0, 4, 3, PAIRS),
    ("salsa_physical_swd_30s", "salsa-physical", 60.0, 4, 3, PAIRS),
    ("salsa_physical_swd_120s", "salsa-physical", 240.0, 4, 4, PAIRS),
)
"""Name, problem, seconds per run, chains, seeds, and samplers."""


def mixing_figures() -> Iterator[tuple[str, float]]:
    """Yield names and values; store results at the end.

    The smallest ``swd_ratio`` is infinite if no sampler finishes all seeds within the budget.
    """
    options = {"draws": DRAWS, "workers": 2, "progress": False}
    runs = []
    for name, problem, seconds, chains, seeds, samplers in ROWS:
        comparison = compare(
            problem, samplers, budget=Budget(seconds=seconds), chains=chains, seeds=seeds, **options
        )  # type: ignore[arg-type]
        table = comparison.table()
        groups = table[table["metric"] == "swd_ratio"].groupby("sampler")["value"]
        ratios = groups.mean()[groups.count() == seeds]
        if ratios.empty:
            yield name, float("inf")
            continue
        best, verdicts = ratios.idxmin(), comparison.verdicts()[problem]
        yield name, float(ratios[best])
        metrics = table[table["sampler"] == best].groupby("metric")["value"].max()
        if "mode_proportions_tv" in metrics:
            for metric in ("mode_proportions_tv", "rhat"):
                yield name.replace("swd", metric), float(metrics[metric])
        runs += [
            LongerRun(problem, sampler, seconds, ratio, verdicts[sampler].is_right)
            for sampler, ratio in ratios.items()
        ]
    advices = [advise(problem) for problem in measured().problems]
    without = {
        advice.problem
        for advice in advices
        if advice.metric.startswith("swd_ratio") and advice.recommended.warnings
    }
    save_longer([run for run in runs if run.seconds > 6])
    yield "problems_without_a_right_sampler", len(without - {r.problem for r in runs if r.right})

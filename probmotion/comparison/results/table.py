"""The table of a comparison: a tidy data frame that prints as mean ± standard deviation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from probmotion.comparison.results.qualities import best_of

__all__ = ["ComparisonTable"]

_BLOCKS: tuple[tuple[str, dict[str, str]], ...] = (
    (
        "against references",
        {
            "seconds": "seconds",
            "swd_ratio": "swd_ratio",
            "variance_ratio": "variance_ratio",
            "mean_error_sd": "mean",
            "off_manifold_ratio": "off_manifold_ratio",
            "log_density_gap": "log p",
            "mode_proportions_tv": "shares",
            "precision": "P",
            "recall": "R",
        },
    ),
    (
        "tests of being alike",
        {"seconds": "seconds", "c2st": "C2ST", "mmd": "MMD²", "ksd": "KSD²"},
    ),
    (
        "against the truth, mm",
        {
            "seconds": "seconds",
            "mpjpe_mm": "MPJPE",
            "mpjpe_mean_mm": "of mean",
            "mpjpe_best_mm": "of best",
            "mpjpe_visible_mm": "visible",
            "mpjpe_occluded_mm": "hidden",
            "g_mpjpe_mm": "G-MPJPE",
            "pa_mpjpe_mm": "PA-MPJPE",
        },
    ),
    (
        "in the world, mm",
        {
            "seconds": "seconds",
            "g_mpjpe_visible_mm": "visible",
            "g_mpjpe_occluded_mm": "hidden",
            "g_mpjpe_mean_mm": "of mean",
            "g_mpjpe_mean_visible_mm": "its visible",
            "g_mpjpe_mean_occluded_mm": "its hidden",
            "acceleration_ratio": "acceleration",
        },
    ),
    (
        "held-out poses",
        {
            "seconds": "seconds",
            "coverage_interaction": "D_IC",
            "coverage_cartesian": "D_C",
            "coverage_shape-context": "D_S",
            "at_cap": "at cap",
            "near_floor": "near floor",
        },
    ),
    (
        "filmed, against real",
        {
            "seconds": "seconds",
            "fid": "FID",
            "diversity_ratio": "diversity",
            "view_precision": "P",
            "view_recall": "R",
            "fid_side": "FID side",
            "view_recall_side": "R side",
            "fid_learnt": "FID learnt",
            "view_recall_learnt": "R learnt",
            "mcd_cm2": "MCD",
        },
    ),
    (
        "the run",
        {
            "seconds": "seconds",
            "denoiser_evaluations": "denoiser",
            "density_evaluations": "density",
            "gradient_evaluations": "gradient",
            "acceptance": "accepted",
            "divergent": "divergent",
            "rhat": "R-hat",
            "ess_bulk": "ESS",
            "ess_tail": "ESS tail",
        },
    ),
)
_LEGEND = """\
swd: sliced Wasserstein distance / that of two exact sets (1 is right); tr: trace of covariance /
exact (1; below: over-confident); mean: error of the mean / √tr (0); off: variance off the prior's
manifold / exact (1); log p: mean log density less exact, nats (0); shares: total variation of the
styles' shares from exact (0); P, R: precision and recall; denoiser, density, gradient: evaluations.
The frame and table.csv hold more measures."""
_SEEDS_LEGEND = """\
±: standard deviation over seeds; *: best of its column, of those with draws at every seed; °: not
to be told from it (intervals of 95 % of paired differences over seeds, Student's at Holm's levels,
hold 0)."""
_TESTS_LEGEND = """\
C2ST: how often a classifier tells a draw from an exact one (0.5: it guesses); MMD²: squared maximum
mean discrepancy from exact draws (0); KSD²: squared kernel Stein discrepancy from density (0)."""
_WORLD_LEGEND = """\
in the world: G-MPJPE, without alignment, of the draws and of their mean; acceleration: mean size of
a joint's acceleration over the truth's (0.5 to 2 is plausible)."""
_TRUTH_LEGEND = """\
against the truth: where references show how far right draws are, single draws are not marked as the
nearest, for those that vary too little are nearer; their mean is."""
_COVERAGE_LEGEND = """\
D_IC, D_C, D_S: mean distance of a held-out pose to its nearest draw in interaction coordinates (m),
joints (root mean square, m) and shape contexts; at cap, near floor: shares of draws where the
density is cut."""

_GENERATION_LEGEND = """\
FID: Fréchet distance of the features of random views and of held-out real ones; it falls with the
number of draws; diversity: mean distance of two motions / real motions' (1 is right); P, R:
precision and recall; side: from π/4 to 3π/4 beside the first view; learnt: against the clips that
were learnt from, which few held-out clips need not be like; MCD: Motion Chamfer Distance to
held-out views, of windows of 10 frames (cm²), where a problem has them; it falls with the number of
draws as well."""


class ComparisonTable(pd.DataFrame):
    """Columns problem, sampler, seed, metric, value; ``print`` shows mean ± sd over seeds.

    ``attrs`` hold the problems' descriptions, the words for cells without draws, and notes.
    Whatever is cut from it is a plain data frame.
    """

    @property
    def _constructor(self) -> type[pd.DataFrame]:
        return pd.DataFrame

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> None:
        return None

    def summary(self) -> str:
        """Return the table as text, a block per problem."""
        problems = list(dict.fromkeys(self["problem"]))
        parts = [self._problem(problem) for problem in problems]
        if self.groupby("problem")["seed"].nunique().gt(1).any():
            parts.append(_SEEDS_LEGEND)
        parts += self.legends()
        if notes := self.attrs.get("notes"):
            parts.append("\n".join(notes))
        return "\n\n".join(parts) if parts else "no cell is finished"

    def legends(self) -> list[str]:
        """Return how to read the measures that it has, a paragraph per kind."""
        return [
            legend
            for metric, legend in (
                ("swd_ratio", _LEGEND),
                ("c2st|ksd", _TESTS_LEGEND),
                ("g_mpjpe_mean_mm", _WORLD_LEGEND),
                ("coverage_cartesian", _COVERAGE_LEGEND),
                ("fid", _GENERATION_LEGEND),
            )
            if self["metric"].isin(metric.split("|")).any()
        ] + [_TRUTH_LEGEND] * self._leaves_nearness_unmarked()

    def _leaves_nearness_unmarked(self) -> bool:
        """Whether some problem has references beside a truth, and seeds enough for marks."""
        return self["seed"].nunique() > 1 and any(
            {"swd_ratio", "mpjpe_mm"} <= set(rows) for _, rows in self.groupby("problem")["metric"]
        )

    def _problem(self, problem: str) -> str:
        """The blocks of one problem, each a measure per column and a sampler per row."""
        rows = pd.DataFrame(self[self["problem"] == problem])
        samplers = list(dict.fromkeys(rows["sampler"]))
        seeds = sorted(set(rows["seed"]))
        words = self.attrs.get("words", {})
        values: dict[tuple[str, str], pd.Series] = {
            (str(sampler), str(metric)): cells.set_index("seed")["value"]
            for (sampler, metric), cells in rows.groupby(["sampler", "metric"])
        }
        lines = [f"{problem}: {self.attrs.get('problems', {}).get(problem, '')}"]
        for title, columns in _BLOCKS:
            shown = {key: head for key, head in columns.items() if key in set(rows["metric"])}
            if not set(shown) - {"seconds"}:
                continue
            body = []
            marks = {metric: self._marks(metric, values, samplers, seeds) for metric in shown}
            for sampler in samplers:
                cells = [
                    _mean_and_sd(values.get((sampler, metric))) + marks[metric].get(sampler, "")
                    for metric in shown
                ]
                if not any(cells) and (sampler, "seconds") not in values:
                    cells[0] = words.get(f"{problem}/{sampler}", "")
                body.append([sampler, *cells])
            lines.append(_aligned([title, *shown.values()], body))
        if len(lines) == 1:
            failed = [[sampler, words.get(f"{problem}/{sampler}", "")] for sampler in samplers]
            lines.append(_aligned(["no draws", ""], failed))
        return "\n".join(lines)

    def _marks(
        self,
        metric: str,
        values: Mapping[tuple[str, str], pd.Series],
        samplers: Sequence[str],
        seeds: Sequence[int],
    ) -> dict[str, str]:
        """Return what stands behind each sampler's number; nothing where none is the best."""
        found = {name: values[name, metric] for name in samplers if (name, metric) in values}
        measured = {other for _, other in values}
        best, tied = best_of(metric, found, seeds, measured, self.attrs.get("draws"))
        if best is None:
            return {}
        return {name: "*" if name == best else "°" if name in tied else " " for name in found}


def _mean_and_sd(values: Any) -> str:
    if values is None:
        return ""
    mean, sd = float(values.mean()), float(values.std())
    if not math.isfinite(mean):
        return "-"
    size, letter = _unit(mean)
    mean, sd = mean / size, sd / size
    if len(values) == 1 or not math.isfinite(sd):
        return f"{mean:.{_decimals(mean, 3)}f}{letter}"
    # Two digits of the standard deviation, and the mean to the same place.
    places = _decimals(sd, 2) if sd > 0 else _decimals(mean, 3)
    return f"{mean:.{places}f} ± {sd:.{places}f}{letter}"


def _unit(value: float) -> tuple[float, str]:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 10 * size:
            return size, letter
    return 1.0, ""


def _decimals(value: float, digits: int) -> int:
    """Places after the point that show so many digits of a value, at most three."""
    if value == 0 or (float(value).is_integer() and abs(value) >= 100):
        return 0
    return min(3, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def _aligned(heads: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    rows = [heads, *body]
    widths = [max(len(row[column]) for row in rows) for column in range(len(heads))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )

"""Comparison table: tidy data frame of metrics, printed as mean ± standard deviation."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence

import pandas as pd

from probmotion.comparison.results.headline_metrics import best_of, headline_metrics, seed_values

__all__ = ["BLOCKS", "ComparisonTable", "mean_and_sd"]

BLOCKS: Mapping[str, Mapping[str, str]] = {
    title: {"seconds": "seconds", **columns}
    for title, columns in {
        "against references": {
            "swd_ratio": "swd ratio",
            "variance_ratio": "variance ratio",
            "mean_error_sd": "mean error (sd)",
            "off_manifold_ratio": "off-manifold ratio",
            "log_density_gap": "log-density gap",
            "mode_proportions_tv": "mode proportions TV",
            "precision": "precision",
            "recall": "recall",
        },
        "two-sample tests": {"c2st": "C2ST", "mmd": "MMD²", "ksd": "KSD²"},
        "against the truth, mm": {
            "mpjpe_mm": "MPJPE",
            "mpjpe_mean_mm": "MPJPE of mean",
            "mpjpe_best_mm": "best MPJPE",
            "mpjpe_visible_mm": "MPJPE visible",
            "mpjpe_occluded_mm": "MPJPE occluded",
            "g_mpjpe_mm": "G-MPJPE",
            "pa_mpjpe_mm": "PA-MPJPE",
        },
        "world coordinates, mm": {
            "g_mpjpe_visible_mm": "G-MPJPE visible",
            "g_mpjpe_occluded_mm": "G-MPJPE occluded",
            "g_mpjpe_mean_mm": "G-MPJPE of mean",
            "g_mpjpe_mean_visible_mm": "of mean, visible",
            "g_mpjpe_mean_occluded_mm": "of mean, occluded",
            "acceleration_ratio": "acceleration ratio",
        },
        "held-out poses": {
            "coverage_interaction": "D_IC",
            "coverage_cartesian": "D_C",
            "coverage_shape-context": "D_S",
            "at_cap": "at cap",
            "near_floor": "near floor",
        },
        "2D views against real": {
            "fid": "FID",
            "diversity_ratio": "diversity ratio",
            "view_precision": "precision",
            "view_recall": "recall",
            "fid_side": "FID side",
            "view_recall_side": "recall side",
            "fid_learnt": "FID training",
            "view_recall_learnt": "recall training",
            "mcd_cm2": "MCD",
        },
        "cost and convergence": {
            "denoiser_evaluations": "denoiser evaluations",
            "density_evaluations": "density evaluations",
            "gradient_evaluations": "gradient evaluations",
            "acceptance": "acceptance",
            "divergent": "divergent",
            "rhat": "R-hat",
            "ess_bulk": "bulk ESS",
            "ess_tail": "tail ESS",
        },
    }.items()
}
"""Column headings by metric, for each block of the table."""

_REFERENCES_LEGEND = """\
swd ratio: sliced Wasserstein distance to the references, divided by that between two reference
sets (ideal: 1); variance ratio: trace of the covariance, divided by that of the references (ideal:
1, overconfident below); mean error (sd): error of the mean in posterior standard deviations (root
of the trace; ideal: 0); off-manifold ratio: variance off the prior's manifold, divided by that of
the references (ideal: 1); log-density gap: mean log density minus that of the references, nats
(ideal: 0); mode proportions TV: total variation distance of mode proportions (ideal: 0).
The data frame and table.csv contain further metrics."""
_SEEDS_LEGEND = """\
±: standard deviation over seeds; *: best of the column among samplers with draws at every seed;
°: statistically tied with the best (Holm-corrected 95 % Student-t intervals of the paired
differences over seeds contain 0)."""
_TESTS_LEGEND = """\
C2ST: accuracy of a classifier that separates draws from references (ideal: 0.5); MMD²: squared
maximum mean discrepancy from the references (ideal: 0); KSD²: squared kernel Stein discrepancy from
the density (ideal: 0)."""
_WORLD_LEGEND = """\
world coordinates: G-MPJPE (without alignment) of the draws and of their mean; acceleration ratio:
mean joint acceleration divided by the truth's (0.5 to 2 is plausible)."""
_TRUTH_LEGEND = """\
against the truth: where there are references, distances of single draws to the truth are not
highlighted, because overconfident draws are closer; those of their mean are."""
_COVERAGE_LEGEND = """\
D_IC, D_C, D_S: mean distance of a held-out pose to its nearest draw in interaction coordinates (m),
joint positions (root mean square, m) and shape contexts; at cap, near floor: proportions of draws
at which the density is clipped."""
_GENERATION_LEGEND = """\
FID: Fréchet distance between features of random views and held-out real views; it decreases with
the number of draws; diversity ratio: mean distance of two motions, divided by that of real motions
(ideal: 1); side: azimuths of π/4 to 3π/4 from the first view; training: against the training clips,
because the few held-out clips may not be representative; MCD: Motion Chamfer Distance to held-out
views in windows of 10 frames (cm²); it also decreases with the number of draws."""
_LEGENDS = (
    ({"swd_ratio"}, _REFERENCES_LEGEND),
    ({"c2st", "ksd"}, _TESTS_LEGEND),
    ({"g_mpjpe_mean_mm"}, _WORLD_LEGEND),
    ({"coverage_cartesian"}, _COVERAGE_LEGEND),
    ({"fid"}, _GENERATION_LEGEND),
)
_NARROWEST = 10
"""Minimum width of wrapped column headings, characters."""
_COLUMNS = 6
"""Maximum number of columns of a table for a paper."""
_LATEX = str.maketrans(
    {character: rf"\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "–": "--"}
    | {"±": r"$\pm$", "×": r"$\times$", "²": "$^2$", "\n": " "}
)
_MARKDOWN = str.maketrans(
    {character: rf"\{character}" for character in "|*[]`\\"}
    | {"<": "&lt;", "&": "&amp;", "\n": " "}
)


class ComparisonTable(pd.DataFrame):
    """Data frame with columns problem, sampler, seed, metric, value; prints mean ± sd over seeds.

    ``attrs`` contains problem descriptions, verdicts, reasons for missing draws, and notes.
    Slices are plain data frames.
    """

    @property
    def _constructor(self) -> type[pd.DataFrame]:
        return pd.DataFrame

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> None:
        return None

    def __str__(self) -> str:
        problems = list(dict.fromkeys(self["problem"]))
        parts = [self._problem(problem) for problem in problems]
        if self.groupby("problem")["seed"].nunique().gt(1).any():
            parts.append(_SEEDS_LEGEND)
        parts += self.legends()
        if notes := self.attrs.get("notes"):
            parts.append("\n".join(notes))
        return "\n\n".join(parts) if parts else "no finished runs"

    def to_latex(self) -> str:
        """Return verdicts and headline metrics as a LaTeX ``tabular`` (package booktabs).

        The table has at most six columns and a row per sampler, with a block per problem. Values
        are mean ± standard deviation over seeds. Bold values are the best of their column or
        statistically tied with the best; this requires at least two seeds.
        """
        header, blocks = self._for_paper()
        lines = [
            rf"\begin{{tabular}}{{ll{'r' * (len(header) - 2)}}}",
            r"\toprule",
            " & ".join(head.translate(_LATEX) for head in header) + r" \\",
        ]
        for problem, rows in blocks.items():
            lines.append(r"\midrule")
            if len(blocks) > 1:
                title = problem.translate(_LATEX)
                lines.append(rf"\multicolumn{{{len(header)}}}{{l}}{{{title}}} \\")
            for row in rows:
                texts = [(text.translate(_LATEX), bold) for text, bold in row]
                cells = [rf"\textbf{{{text}}}" if bold else text for text, bold in texts]
                lines.append(" & ".join(cells) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])

    def to_markdown(self) -> str:
        """Return verdicts and headline metrics as Markdown, a table per problem as in LaTeX."""
        header, blocks = self._for_paper()
        rules = ["---", "---", *["---:"] * (len(header) - 2)]
        tables = []
        for problem, rows in blocks.items():
            lines = [f"{problem.translate(_MARKDOWN)}\n"] if len(blocks) > 1 else []
            lines += [f"| {' | '.join(header)} |", f"| {' | '.join(rules)} |"]
            for row in rows:
                texts = [(text.translate(_MARKDOWN), bold) for text, bold in row]
                cells = [f"**{text}**" if bold else text for text, bold in texts]
                lines.append(f"| {' | '.join(cells)} |")
            tables.append("\n".join(lines))
        return "\n\n".join(tables)

    def _for_paper(self) -> tuple[list[str], dict[str, list[list[tuple[str, bool]]]]]:
        """Return the headings, and by problem a row per sampler of texts and whether bold."""
        metrics = ["seconds", *headline_metrics(self)][: _COLUMNS - 2]
        names = {key: head for columns in BLOCKS.values() for key, head in columns.items()}
        blocks: dict[str, list[list[tuple[str, bool]]]] = {}
        for problem in dict.fromkeys(self["problem"]):
            rows = pd.DataFrame(self[self["problem"] == problem])
            samplers, seeds = list(dict.fromkeys(rows["sampler"])), sorted(set(rows["seed"]))
            values = seed_values(rows)
            symbols = {metric: self._symbols(metric, values, samplers, seeds) for metric in metrics}
            verdicts = self.attrs.get("verdicts", {}).get(problem, {})
            blocks[problem] = [
                [(sampler, False), (verdicts.get(sampler, ("–",))[0], False)]
                + [
                    (
                        mean_and_sd(values.get((sampler, metric))) or "–",
                        symbols[metric].get(sampler, " ") != " ",
                    )
                    for metric in metrics
                ]
                for sampler in samplers
            ]
        return ["sampler", "verdict", *(names[metric] for metric in metrics)], blocks

    def legends(self) -> list[str]:
        """Return explanations of the metrics in the table."""
        measured = set(self["metric"])
        legends = [legend for metrics, legend in _LEGENDS if metrics & measured]
        unmarked = self["seed"].nunique() > 1 and any(
            {"swd_ratio", "mpjpe_mm"} <= set(rows) for _, rows in self.groupby("problem")["metric"]
        )
        return [*legends, _TRUTH_LEGEND] if unmarked else legends

    def _problem(self, problem: str) -> str:
        """Return the blocks of one problem, with a column per metric and a row per sampler."""
        rows = pd.DataFrame(self[self["problem"] == problem])
        samplers = list(dict.fromkeys(rows["sampler"]))
        seeds = sorted(set(rows["seed"]))
        words = self.attrs.get("words", {})
        values = seed_values(rows)
        lines = [f"{problem}: {self.attrs.get('problems', {}).get(problem, '')}"]
        verdicts = self.attrs.get("verdicts", {}).get(problem, {})
        # Notes contain the reasons of failures.
        judged = [[name, each] for name, (_, each) in verdicts.items() if name in samplers and each]
        if judged:
            width = max(len(name) for name, _ in judged)
            lines += ["verdicts", *(f"{name:{width}}  {sentence}" for name, sentence in judged), ""]
        for title, columns in BLOCKS.items():
            shown = {key: head for key, head in columns.items() if key in set(rows["metric"])}
            if not set(shown) - {"seconds"}:
                continue
            body = []
            symbols = {metric: self._symbols(metric, values, samplers, seeds) for metric in shown}
            for sampler in samplers:
                entries = [
                    mean_and_sd(values.get((sampler, metric))) + symbols[metric].get(sampler, "")
                    for metric in shown
                ]
                if not any(entries) and (sampler, "seconds") not in values:
                    entries[0] = words.get(f"{problem}/{sampler}", "")
                body.append([sampler, *entries])
            lines.append(_aligned([title, *shown.values()], body))
        if not values.keys() - {
            (name, word) for name in samplers for word in ("unsupported", "failed")
        }:
            failed = [[sampler, words.get(f"{problem}/{sampler}", "")] for sampler in samplers]
            lines.append(_aligned(["no draws", ""], failed))
        return "\n".join(lines)

    def _symbols(
        self,
        metric: str,
        values: Mapping[tuple[str, str], pd.Series],
        samplers: Sequence[str],
        seeds: Sequence[int],
    ) -> dict[str, str]:
        """Return the symbol after each sampler's value; empty if the metric has no best value."""
        by_sampler = {name: values[name, metric] for name in samplers if (name, metric) in values}
        measured = {other for _, other in values}
        best, tied = best_of(metric, by_sampler, seeds, measured, self.attrs.get("draws"))
        if best is None:
            return {}
        return {name: "*" if name == best else "°" if name in tied else " " for name in by_sampler}


def mean_and_sd(values: pd.Series | None) -> str:
    """Return mean ± standard deviation, rounded to significant digits; empty for None."""
    if values is None:
        return ""
    mean, sd = float(values.mean()), float(values.std())
    if not math.isfinite(mean):
        return "-"
    size, letter = _unit(mean)
    mean, sd = mean / size, sd / size
    if len(values) == 1 or not math.isfinite(sd):
        return f"{mean:.{_decimals(mean, 3)}f}{letter}"
    # Two significant digits of the standard deviation, and the same decimal places of the mean.
    places = _decimals(sd, 2) if sd > 0 else _decimals(mean, 3)
    return f"{mean:.{places}f} ± {sd:.{places}f}{letter}"


def _unit(value: float) -> tuple[float, str]:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 10 * size:
            return size, letter
    return 1.0, ""


def _decimals(value: float, digits: int) -> int:
    """Return the number of decimal places, at most 3, for ``digits`` significant digits."""
    if value == 0 or (float(value).is_integer() and abs(value) >= 100):
        return 0
    return min(3, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def _aligned(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return aligned columns; all headings except the first are wrapped to the column width."""
    headings = [[header[0]]]
    for heading, *column in zip(header[1:], *(row[1:] for row in body), strict=True):
        width = max(_NARROWEST, *map(len, column))
        headings.append(
            textwrap.wrap(heading, width, break_long_words=False, break_on_hyphens=False) or [""]
        )
    height = max(map(len, headings))
    rows = [*zip(*([""] * (height - len(h)) + h for h in headings), strict=True), *body]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            entry.ljust(width) if column == 0 else entry.rjust(width)
            for column, (entry, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )

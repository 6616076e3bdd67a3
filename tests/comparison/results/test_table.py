"""The printed table, highlights, and files of a comparison."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from toy_samplers import SMALL, PriorDraws, Walking, generation

from probmotion.citations import CITATIONS, citations_of
from probmotion.comparison import QUICK, Budget, Comparison, compare, quick_samplers
from probmotion.comparison.results.headline_metrics import best_of, headline_metric
from probmotion.comparison.results.table import ComparisonTable, mean_and_sd
from probmotion.posteriors.sampling import sampler_names
from probmotion.samplers import ScoreDistillation
from probmotion.samplers.conditional import DAPS, REDDiff, TwistedDiffusion
from probmotion.samplers.diffusion import StochSync, SyncTweedies


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([1.2345], "1.23"),
        ([0.00012], "0.000"),
        ([123.4], "123"),
        ([200000.0], "200k"),
        ([2.5e6], "2500k"),
        ([1.0, 2.0, 3.0], "2.0 ± 1.0"),
        ([0.991, 1.009], "1.000 ± 0.013"),
        ([250.0, 350.0], "300 ± 71"),
        ([-12000.0, -14000.0], "-13.0 ± 1.4k"),
        ([5.0, 5.0], "5.00 ± 0.00"),
        ([math.nan], "-"),
    ],
)
def test_numbers_have_significant_digits(values, text):
    assert mean_and_sd(pd.Series(values)) == text


def test_table_prints_means_with_wrapped_headings_failures_and_notes(grid):
    table = grid.table()
    text = str(table)
    assert repr(table) == text
    wide = table.query("problem == 'generation' and sampler == 'wide'")
    swd = wide[wide["metric"] == "swd_ratio"]["value"]
    assert f"{swd.mean():.3f} ± {swd.std():.3f}" in text
    lines = text.splitlines()
    heading = next(n for n, line in enumerate(lines) if line.startswith("against reference"))
    assert lines[heading].split()[2:7] == ["seconds", "swd", "ratio", "variance", "ratio"]
    assert lines[heading - 1].split()[:2] == ["mean", "error"]
    assert text.index("generation: no observations") < text.index("monocular: one camera")
    rows = [line.split() for line in lines]
    assert ["wide", "observations"] in rows
    assert ["crashing", "RuntimeError"] in rows
    assert "wide ran with spread=2.0 and defaults otherwise" in text
    assert "(0.5 to 2 is plausible)" in text
    assert max(map(len, lines)) < 160


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"swd_ratio": 1.2, "coverage_interaction": 0.1, "fid": 30.0}, "swd_ratio"),
        ({"fid": 30.0, "coverage_interaction": 0.1}, "coverage_interaction"),
        ({"g_mpjpe_mm": 3.0, "fid": 30.0}, "fid"),
        # Values without a logarithm cannot be plotted.
        ({"swd_ratio": np.inf, "fid": 30.0}, "fid"),
        ({"swd_ratio": 0.0, "g_mpjpe_mm": 3.0}, "g_mpjpe_mm"),
        ({"swd_ratio": np.nan}, None),
        ({"diversity": 0.7, "seconds": 2.0}, None),
        ({}, None),
    ],
)
def test_headline_metric_is_the_first_finite_positive_one(values, expected):
    table = pd.DataFrame({"metric": list(values), "value": values.values()})
    assert headline_metric(table) == expected


def test_best_values_follow_the_kind_of_metric():
    values = {"a": pd.Series([1.0, 1.1, 0.9, 1.0]), "b": pd.Series([2.0, 2.1, 1.9, 2.0])}
    nobody = (None, set())
    assert best_of("variance_ratio", values, range(4)) == ("a", {"a"})
    assert best_of("precision", values, range(4)) == ("b", {"b"})
    assert best_of("seconds", values, range(4)) == nobody
    assert best_of("variance_ratio", {"a": values["a"]}, range(4)) == nobody
    infinite = {"a": values["a"], "b": values["b"] * np.inf}
    assert best_of("swd_ratio", infinite, range(4)) == nobody
    # With references, draws closer to the truth than the references are no better.
    for metric in ("mpjpe_mm", "g_mpjpe_occluded_mm", "mpjpe_best_mm", "velocity_error"):
        assert best_of(metric, values, range(4), {metric, "fid"}) == ("a", {"a"})
        assert best_of(metric, values, range(4), {metric, "swd_ratio"}) == nobody
    assert best_of("g_mpjpe_mean_mm", values, range(4), {"swd_ratio"}) == ("a", {"a"})
    # A single seed has no spread.
    first = {name: row[:1] for name, row in values.items()}
    assert best_of("variance_ratio", first, range(1)) == nobody
    assert best_of("variance_ratio", first, range(4)) == nobody


def test_proportions_of_few_draws_are_tied_within_their_step():
    values = {"a": pd.Series([0.9, 0.95]), "b": pd.Series([0.85, 0.9])}
    table = table_of({"precision": values})
    for draws, tied in ((None, False), (20, True), (2000, False)):
        for metric in ("precision", "c2st"):
            assert len(best_of(metric, values, range(2), draws=draws)[1]) == 1 + tied
        table.attrs = {"draws": draws}
        assert ("0.875 ± 0.035°" in str(table)) == tied


def table_of(metrics) -> ComparisonTable:
    """Return a table of one problem from values by metric, sampler and seed."""
    rows = [
        ("p", name, seed, metric, value)
        for metric, samplers in metrics.items()
        for name, values in samplers.items()
        for seed, value in enumerate(values)
    ]
    return ComparisonTable(rows, columns=["problem", "sampler", "seed", "metric", "value"])


def test_legend_explains_missing_highlights_of_distances_to_the_truth():
    for metrics, seeds, explained in (
        (("swd_ratio", "mpjpe_mm"), 2, True),
        (("mpjpe_mm",), 2, False),
        (("swd_ratio", "mpjpe_mm"), 1, False),
    ):
        table = table_of({metric: {"a": seeds * [1.0], "b": seeds * [5.0]} for metric in metrics})
        text = " ".join(str(table).split())
        assert ("distances of single draws to the truth are not high" in text) == explained


def test_best_and_tied_samplers_are_marked():
    swd = {"good": [1.0, 1.1, 0.95], "bad": [3.0, 3.2, 3.1], "equal": [1.1, 1.0, 1.2]}
    seconds = {name: [1.0, 2.0, 3.0] for name in swd}
    text = str(table_of({"swd_ratio": swd, "seconds": seconds}))
    rows = {line.split()[0]: line for line in text.splitlines() if " ± " in line}
    assert rows["good"].endswith("1.017 ± 0.076*")
    assert rows["equal"].endswith("1.10 ± 0.10°")
    assert rows["bad"].endswith("3.10 ± 0.10")
    # Seconds have no best value, and numbers remain aligned.
    assert [line.count("*") + line.count("°") for line in rows.values()] == [1, 0, 1]
    assert len(rows["good"]) == len(rows["equal"]) == len(rows["bad"]) + 1
    assert "*: best of the column among samplers with draws at every seed" in text
    single = {name: values[:1] for name, values in swd.items()}
    assert not {"*", "°", "±"} & set(str(table_of({"swd_ratio": single})))


def paper_table() -> ComparisonTable:
    swd = {"good_1": [1.0, 1.1, 0.95], "50 % & <more>": [1.1, 1.0, 1.2], "bad|$x^2$": [3, 3.2, 3.1]}
    more = {name: [1.0] for name in swd}
    table = table_of({"swd_ratio": swd, "c2st": more, "mpjpe_mm": more, "seconds": more})
    table.attrs = {"verdicts": {"p": {"bad|$x^2$": ("overconfident ×1.3", "")}}}
    return table


def test_latex_has_a_row_per_sampler_and_no_unescaped_characters():
    lines = paper_table().to_latex().splitlines()
    assert lines[:2] == [r"\begin{tabular}{llrrr}", r"\toprule"]
    assert lines[2] == r"sampler & verdict & seconds & swd ratio & C2ST \\"
    assert lines[3] == r"\midrule"
    assert lines[4:7] == [
        r"good\_1 & -- & 1.00 & \textbf{1.017 $\pm$ 0.076} & 1.00 \\",
        r"50 \% \& \textless{}more\textgreater{} & -- & 1.00 & \textbf{1.10 $\pm$ 0.10} & 1.00 \\",
        r"bad\textbar{}\$x\textasciicircum{}2\$ & overconfident $\times$1.3 & 1.00 & "
        r"3.10 $\pm$ 0.10 & 1.00 \\",
    ]
    assert lines[7:] == [r"\bottomrule", r"\end{tabular}"]


def test_markdown_has_the_cells_of_latex():
    rows = paper_table().to_markdown().splitlines()
    assert rows[0] == "| sampler | verdict | seconds | swd ratio | C2ST |"
    assert rows[1] == "| --- | --- | ---: | ---: | ---: |"
    assert rows[2] == "| good_1 | – | 1.00 | **1.017 ± 0.076** | 1.00 |"
    assert rows[3].startswith("| 50 % &amp; &lt;more> | – |")
    assert rows[4].startswith(r"| bad\|$x^2$ | overconfident ×1.3 |")
    assert len(rows) == 5


def test_paper_tables_have_at_most_six_columns_for_every_problem(grid):
    table = grid.table()
    rows = [line for line in table.to_latex().splitlines() if "&" in line]
    assert {row.count(" & ") for row in rows} == {5}
    assert len(rows) == 1 + 2 * 3
    assert r"\multicolumn{6}{l}{monocular} \\" in table.to_latex()
    assert any(row.startswith("wide & no draws (observations) & -- &") for row in rows)
    assert not any(char in table.to_latex() for char in "±×–")
    blocks = table.to_markdown().split("\n\n")
    assert blocks[0] == "generation"
    assert blocks[2] == "monocular"
    assert [len(block.splitlines()) for block in blocks[1::2]] == [5, 5]


def test_slices_and_the_stored_table_are_plain_frames(grid):
    table = grid.table()
    assert isinstance(table, ComparisonTable)
    assert type(table[table["seed"] == 0]) is pd.DataFrame
    assert type(table.groupby("metric").mean(numeric_only=True)) is pd.DataFrame
    stored = pd.read_csv(grid.folder / "table.csv")
    pd.testing.assert_frame_equal(stored, pd.DataFrame(table), check_exact=True)


def test_a_copy_is_complete_and_can_be_continued(grid, tmp_path):
    grid.write(tmp_path / "copy")
    copy = Comparison.load(tmp_path / "copy")
    assert copy.table().to_csv() == grid.table().to_csv()
    copied, draws = (each.draws("generation", "wide", 1).flat() for each in (copy, grid))
    np.testing.assert_array_equal(copied, draws)
    settings = {**SMALL, "budget": Budget(evaluations=2000)}
    compare(generation(), Walking(), out=tmp_path / "one", **settings).write(tmp_path / "two")
    more = compare(generation(), Walking(), out=tmp_path / "two", **settings | {"seeds": 2})
    assert more.failures == []


def test_a_temporary_folder_is_removed_with_its_comparison():
    comparison = compare(generation(), PriorDraws(), **SMALL)
    folder = comparison.folder
    assert (folder / "table.csv").exists()
    del comparison
    assert not folder.exists()


def test_quick_samplers_have_reduced_settings():
    quick = quick_samplers()
    assert list(quick) == sampler_names()
    assert quick["sds"] == ScoreDistillation(**QUICK["sds"]) != ScoreDistillation()


def test_every_sampler_has_citations():
    for name in sampler_names():
        assert len(citations_of(name)) >= 2
    # Rivals are not registered.
    rivals = (DAPS, REDDiff, TwistedDiffusion, StochSync, SyncTweedies)
    assert set(CITATIONS) == {*sampler_names(), *(rival.name for rival in rivals)}
    assert len(citations_of("someone's own")) == 1

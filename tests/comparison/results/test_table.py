"""What the table prints, and that it survives the way to a folder and back."""

from __future__ import annotations

import json
import math

import numpy as np
import pandas as pd
import pytest
from toy_samplers import PriorDraws, Walking, generation, monocular

from probmotion.citations import CITATIONS, citations_of
from probmotion.comparison import QUICK, Budget, Comparison, compare, quick_samplers
from probmotion.comparison.results.qualities import best_of, first_quality
from probmotion.comparison.results.table import ComparisonTable, _mean_and_sd
from probmotion.posteriors.sampling import sampler_names
from probmotion.samplers import ExactSampler, ScoreDistillation

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}


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
def test_numbers_show_what_they_are_worth(values, text):
    assert _mean_and_sd(pd.Series(values)) == text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("comparison")
    samplers = {"exact": ExactSampler(), "wide": PriorDraws(2.0)}
    compare([generation(), monocular()], samplers, seeds=2, out=out, **SMALL)
    return out


def test_it_prints_means_and_deviations_with_cost_beside_quality(folder):
    comparison = Comparison.load(folder)
    table = comparison.table()
    text = str(table)
    assert repr(comparison) == text == repr(table)
    swd = table.query("problem == 'generation' and sampler == 'wide' and metric == 'swd_ratio'")[
        "value"
    ]
    assert f"{swd.mean():.2f} ± " in text or f"{swd.mean():.1f} ± " in text
    heads = next(line for line in text.splitlines() if line.startswith("against reference"))
    assert heads.split()[2:5] == ["seconds", "swd_ratio", "variance_ratio"]
    assert text.index("generation: no evidence") < text.index("monocular: one camera")
    assert ["wide", "observations"] in [line.split() for line in text.splitlines()]
    assert "wide ran with spread=2.0; its other settings are its defaults" in text
    world = next(line for line in text.splitlines() if line.startswith("in the world, mm"))
    assert world.split()[4:] == ["seconds", "of", "mean", "acceleration"]
    assert "(0.5 to 2 is plausible)" in text
    assert max(map(len, text.splitlines())) < 160


def test_marks_are_of_what_can_be_right_or_wrong():
    values = {"a": pd.Series([1.0, 1.1, 0.9, 1.0]), "b": pd.Series([2.0, 2.1, 1.9, 2.0])}
    assert best_of("variance_ratio", values, range(4)) == ("a", {"a"})
    assert best_of("precision", values, range(4)) == ("b", {"b"})
    assert best_of("seconds", values, range(4)) == (None, set())
    assert best_of("variance_ratio", {"a": values["a"]}, range(4)) == (None, set())
    assert best_of("swd_ratio", {"a": values["a"], "b": values["b"] * np.inf}, range(4)) == (
        None,
        set(),
    )
    # Where right draws are known, to be nearer to the truth than they are is no merit.
    for metric in ("mpjpe_mm", "g_mpjpe_occluded_mm", "mpjpe_best_mm", "velocity_error"):
        assert best_of(metric, values, range(4), {metric, "fid"}) == ("a", {"a"})
        assert best_of(metric, values, range(4), {metric, "swd_ratio"}) == (None, set())
    assert best_of("g_mpjpe_mean_mm", values, range(4), {"swd_ratio"}) == ("a", {"a"})
    # However far two numbers are apart, one seed tells nothing.
    first = {name: row[:1] for name, row in values.items()}
    assert best_of("variance_ratio", first, range(1)) == (None, set())
    assert best_of("variance_ratio", first, range(4)) == (None, set())


def test_shares_of_few_draws_differ_by_more_than_one_at_two_seeds():
    values = {"a": pd.Series([0.9, 0.95]), "b": pd.Series([0.85, 0.9])}
    for metric in ("precision", "c2st"):
        assert len(best_of(metric, values, range(2))[1]) == 1
        assert len(best_of(metric, values, range(2), draws=20)[1]) == 2
        assert len(best_of(metric, values, range(2), draws=2000)[1]) == 1
    table = ComparisonTable(
        [
            {"problem": "p", "sampler": name, "seed": seed, "metric": "precision", "value": value}
            for name, row in values.items()
            for seed, value in row.items()
        ]
    )
    for draws, marked in ((None, False), (20, True), (2000, False)):
        table.attrs = {"draws": draws}
        assert ("0.875 ± 0.035°" in str(table)) == marked


def test_where_nearness_to_the_truth_is_not_marked_is_said():
    near = {"p": {"swd_ratio": 1.0, "mpjpe_mm": 5.0}, "q": {"mpjpe_mm": 5.0}}
    for problems, seeds, said in (("pq", 2, True), ("q", 2, False), ("p", 1, False)):
        rows = [
            {"problem": problem, "sampler": name, "seed": seed, "metric": metric, "value": value}
            for problem in problems
            for name in "ab"
            for seed in range(seeds)
            for metric, value in near[problem].items()
        ]
        text = " ".join(str(ComparisonTable(rows)).split())
        assert ("single draws are not marked as the nearest" in text) == said


def made_table(**swd):
    """Columns of three seeds, with seconds for all."""
    rows = [
        {"problem": "p", "sampler": name, "seed": seed, "metric": metric, "value": value}
        for name, values in swd.items()
        for seed, each in enumerate(values)
        for metric, value in (("swd_ratio", each), ("seconds", 1.0 + seed))
    ]
    return ComparisonTable(rows)


def test_the_best_and_those_that_are_not_told_from_it_are_marked():
    text = str(made_table(near=[1.0, 1.1, 0.95], far=[3.0, 3.2, 3.1], alike=[1.1, 1.0, 1.2]))
    rows = {line.split()[0]: line for line in text.splitlines() if " ± " in line}
    assert rows["near"].endswith("1.017 ± 0.076*")
    assert rows["alike"].endswith("1.10 ± 0.10°")
    assert rows["far"].endswith("3.10 ± 0.10")
    # Seconds are neither right nor wrong, and numbers stay one below the other.
    assert [line.count("*") + line.count("°") for line in rows.values()] == [1, 0, 1]
    assert len(rows["near"]) == len(rows["alike"]) == len(rows["far"]) + 1
    assert "±: standard deviation over seeds; *: best of its column, of those with draws" in text


def test_what_says_most_is_the_first_that_was_measured():
    table = made_table(a=[1.0, 2.0])
    truth = pd.DataFrame(
        {"metric": ["g_mpjpe_mm", "fid", "swd_ratio"], "value": [3.0, 2.0, math.nan]}
    )
    assert first_quality(table) == "swd_ratio"
    assert first_quality(truth) == "fid"
    assert first_quality(truth[:1]) == "g_mpjpe_mm"
    assert first_quality(table.query("metric == 'seconds'")) is None


def test_with_one_seed_nothing_is_marked():
    text = str(made_table(near=[1.0], far=[3.0]))
    assert not {"*", "°", "±"} & set(text)


def test_what_is_cut_from_it_is_a_plain_frame(folder):
    table = Comparison.load(folder).table()
    assert isinstance(table, ComparisonTable)
    assert type(table[table["seed"] == 0]) is pd.DataFrame
    assert type(table.groupby("metric").mean(numeric_only=True)) is pd.DataFrame


def test_the_files_hold_the_table_and_the_failures(folder):
    kept = pd.read_csv(folder / "table.csv")
    table = Comparison.load(folder).table()
    assert list(kept.columns) == ["problem", "sampler", "seed", "metric", "value"]
    np.testing.assert_array_equal(kept["value"], table["value"])
    failures = json.loads((folder / "failures.json").read_text())
    assert [(each["sampler"], each["word"]) for each in failures] == [("wide", "observations")] * 2


def test_a_comparison_can_be_written_elsewhere_and_read_back(folder, tmp_path):
    comparison = Comparison.load(folder)
    comparison.write(tmp_path / "copy")
    copy = Comparison.load(tmp_path / "copy")
    pd.testing.assert_frame_equal(
        pd.DataFrame(copy.table()), pd.DataFrame(comparison.table()), check_exact=True
    )
    np.testing.assert_array_equal(
        copy.draws("generation", "wide", 1).flat(), comparison.draws("generation", "wide", 1).flat()
    )


def test_what_was_written_elsewhere_goes_on_there(tmp_path):
    asked = {**SMALL, "budget": Budget(evaluations=2000)}
    compare(generation(), Walking(), out=tmp_path / "one", **asked).write(tmp_path / "two")
    # A budget of seconds is one however it is written.
    assert Budget(seconds=6) == Budget(seconds=6.0)
    assert repr(Budget(seconds=6)) == repr(Budget(seconds=6.0))
    more = compare(generation(), Walking(), out=tmp_path / "two", **asked | {"seeds": 2})
    assert [result.failure for result in more.results] == [None, None]


def test_a_temporary_comparison_takes_its_folder_with_it():
    comparison = compare(generation(), PriorDraws(), **SMALL)
    folder = comparison.folder
    assert (folder / "table.csv").exists()
    del comparison
    assert not folder.exists()


def test_quick_settings_are_shown_and_stored():
    quick = quick_samplers()
    assert list(quick) == sampler_names()
    assert quick["sds"] == ScoreDistillation(**QUICK["sds"])
    assert quick["sds"] != ScoreDistillation()
    comparison = compare(
        generation(), {"sds": ScoreDistillation(iterations=3)}, **(SMALL | {"draws": 10})
    )
    assert "sds ran with iterations=3; its other settings are its defaults" in str(comparison)
    settings = json.loads(comparison.draws("generation", "sds").dataset.attrs["settings"])
    assert settings["iterations"] == 3


def test_every_sampler_says_what_to_cite():
    for name in sampler_names():
        assert len(citations_of(name)) >= 2
    assert set(CITATIONS) == set(sampler_names())
    assert len(citations_of("someone's own")) == 1

"""Advice follows from the measurements and reports their numbers."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from probmotion.cli.main import main
from probmotion.comparison import advise, compare, measured
from probmotion.comparison.measurements import (
    LongerRun,
    Measured,
    save_longer,
    save_measurements,
)
from probmotion.posteriors.sampling import sampler_names
from probmotion.problems import load_problem, problem_names
from probmotion.samplers import ExactSampler, ScoreDistillation


def measurements(headline="swd_ratio", seconds=None, more=(), **values):
    """Return measurements of one problem with three seeds."""
    seconds = {name: 6.0 for name in values} | (seconds or {})
    rows = [
        ("p", name, seed, metric, value)
        for name, each in values.items()
        for seed, quality in enumerate(each)
        for metric, value in ((headline, quality), ("seconds", seconds[name]))
    ]
    rows += [("p", name, seed, metric, value) for name, metric, value in more for seed in range(3)]
    table = pd.DataFrame(rows, columns=["problem", "sampler", "seed", "metric", "value"])
    notes, problems, words = ["all had 6 seconds"], {"p": "a problem"}, {"p/sds": "observations"}
    return Measured(table, "made here", 40, 3, 1.3, notes, problems, [*values, "sds"], words)


def names(standings):
    return [each.sampler for each in standings]


GOOD, EQUAL, BAD = [1.0, 1.02, 0.97], [1.03, 0.99, 1.05], [2.0, 2.1, 2.05]


def test_the_best_is_recommended_and_others_are_tied_or_worse():
    result = advise("p", measurements(good=GOOD, bad=BAD, equal=EQUAL, worst=[3.0, 3.1, 3.05]))
    assert result.recommended.sampler == "good"
    assert result.recommended.value == pytest.approx(sum(GOOD) / 3)
    assert names(result.tied) == ["equal"]
    assert names(result.worse) == ["bad", "worst"]
    assert result.without_draws == {"sds": "observations"}
    text = str(result)
    assert "recommended: good 0.997 ± 0.025 in 6 s" in text
    assert "worse: bad 2.05 ± 0.05 in 6 s (far from the references: swd ratio 2.05); wors" in text
    assert "without draws: sds (observations)" in text
    assert "40 draws, 3 seeds, all had 6 seconds (made here)" in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_tied_sampler_in_less_than_half_the_time_is_recommended():
    values = {"good": GOOD, "equal": EQUAL, "bad": BAD}
    quick = advise("p", measurements(seconds={"equal": 2.9, "bad": 0.1}, **values))
    assert quick.recommended.sampler == "equal"
    assert names(quick.tied) == ["good"]
    slower = advise("p", measurements(seconds={"equal": 3.1}, **values))
    assert slower.recommended.sampler == "good"


def test_ratios_are_compared_on_a_logarithmic_scale():
    bad = {"quarter": [0.25, 0.26, 0.24], "half": [0.5, 0.51, 0.49], "thrice": [3.0, 3.1, 2.9]}
    assert names(advise("p", measurements(good=GOOD, **bad)).worse) == ["half", "thrice", "quarter"]


@pytest.mark.parametrize(
    ("metric", "value", "warning"),
    [
        ("variance_ratio", 0.5, "wrong spread: variance ratio 0.5"),
        ("variance_ratio", 1.6, "wrong spread: variance ratio 1.6"),
        ("off_manifold_ratio", 3.0, "wrong off-manifold variance: ratio 3"),
        ("c2st", 0.9, "a classifier separates it from the references: C2ST 0.9"),
        ("mode_proportions_tv", 0.4, "wrong mode proportions: TV 0.4"),
        ("rhat", 1.4, "chains disagree: R-hat 1.4"),
    ],
)
def test_metrics_out_of_range_are_warnings(metric, value, warning):
    usual = [("a", metric, {"mode_proportions_tv": 0.0, "c2st": 0.5}.get(metric, 1.0))]
    slightly = [1.2, 1.21, 1.19]
    result = advise("p", measurements(a=GOOD, b=slightly, more=[*usual, ("b", metric, value)]))
    assert result.recommended.warnings == ()
    assert result.worse[0].warnings == (warning,)
    assert f"b 1.2 ± 0.01 in 6 s ({warning})" in " ".join(str(result).split())


@pytest.mark.parametrize(
    ("rhat", "warnings"),
    [
        ([1.1, 1.1, 1.4], ()),
        ([1.1, 1.4, 1.6], ("chains disagree at 2 of 3 seeds: R-hat 1.5",)),
        ([1.4, 1.4, 1.4], ("chains disagree: R-hat 1.4",)),
    ],
)
def test_rhat_warns_at_more_seeds_than_by_chance(rhat, warnings):
    """One of three seeds exceeds the limit in 14 % of tables with mixed chains."""
    result = measurements(b=[1.2, 1.21, 1.19])
    rows = [("p", "b", seed, "rhat", value) for seed, value in enumerate(rhat)]
    rows = pd.concat([result.rows, pd.DataFrame(rows, columns=result.rows.columns)])
    assert advise("p", replace(result, rows=rows)).recommended.warnings == warnings


def test_samplers_with_warnings_are_recommended_only_without_alternative():
    doubtful = [("good", "rhat", 2.0)]
    result = advise("p", measurements(good=GOOD, equal=EQUAL, more=doubtful))
    assert (result.recommended.sampler, result.tied) == ("equal", ())
    assert names(result.tied_with_warnings) == ["good"]
    text = " ".join(str(result).split())
    assert "with warnings: good 0.997 ± 0.025 in 6 s (chains disagree: R-hat 2)" in text
    alone = advise("p", measurements(good=GOOD, bad=BAD, more=doubtful))
    assert "no reliable sampler; best: good 0.997" in str(alone)
    assert "no reliable sampler; best: bad 2.05" in str(advise("p", measurements(bad=BAD)))


def test_without_alternative_the_cheapest_longer_run_that_is_right_is_named():
    runs = [
        LongerRun("p", "bad", 600.0, 1.01, True),
        LongerRun("p", "bad", 240.0, 1.0625, True),
        LongerRun("p", "bad", 60.0, 1.4, False),
        LongerRun("q", "bad", 30.0, 1.0, True),
    ]
    text = str(advise("p", replace(measurements(bad=BAD), longer=tuple(runs))))
    assert "\nright with more time: bad, 240 s per run, swd ratio 1.06\n" in text
    few = replace(measurements(bad=BAD), longer=tuple(runs[2:]))
    assert "more time" not in str(advise("p", few))
    enough = replace(measurements(good=GOOD, bad=BAD), longer=tuple(runs))
    assert "more time" not in str(advise("p", enough))


def test_longer_runs_are_saved_and_read(tmp_path):
    problem = load_problem("gait", frames=4)
    samplers = {"exact": ExactSampler()}
    comparison = compare(problem, samplers, draws=12, seeds=2, workers=0, progress=False)
    save_measurements(comparison, "a test", tmp_path)
    runs = [LongerRun("gait", "exact", 60.0, 1.0625, True), LongerRun("p", "q", 9.0, 2.0, False)]
    save_longer(runs, tmp_path)
    assert measured(tmp_path).longer == tuple(runs)
    save_longer([], tmp_path)
    measured.cache_clear()
    assert measured(tmp_path).longer == ()


def test_a_single_sampler_is_recommended():
    result = advise("p", measurements("fid", only=GOOD))
    assert (result.recommended.sampler, result.tied, result.worse) == ("only", (), ())
    assert "on par: none" in str(result)


def test_missing_seeds_are_warnings():
    nan = float("nan")
    result = advise("p", measurements(good=GOOD, some=[1.0, nan, nan], none=[nan, nan, nan]))
    assert result.recommended.sampler == "good"
    assert [each.warnings for each in result.tied_with_warnings] == [("draws at 1 of 3 seeds",)]
    assert "nan" not in str(result)


def test_measurements_of_a_comparison_are_saved_and_read(tmp_path):
    problem = load_problem("gait", frames=4)
    samplers = {"exact": ExactSampler(), "sds": ScoreDistillation(iterations=3)}
    comparison = compare(problem, samplers, draws=12, chains=2, seeds=2, workers=0, progress=False)
    save_measurements(comparison, "a test", tmp_path)
    result = measured(tmp_path)
    assert (result.command, result.draws, result.seeds) == ("a test", 12, 2)
    assert result.rhat_at_most > 1.1
    assert result.samplers == ["exact", "sds"]
    table = comparison.table()
    swd = table[table["metric"] == "swd_ratio"]["value"].mean()
    stored = result.rows[result.rows["metric"] == "swd_ratio"]["value"].mean()
    assert stored == pytest.approx(swd, rel=1e-4)
    assert advise(problem.name, result).recommended.sampler == "exact"


def test_shipped_measurements_cover_every_sampler_and_problem():
    result = measured()
    assert list(result.problems) == problem_names()
    assert result.samplers == sampler_names()
    for problem in result.problems:
        advice = advise(problem)
        best = names([advice.recommended, *advice.tied])
        others = names([*advice.tied_with_warnings, *advice.worse])
        assert {*best, *others, *advice.without_draws} == set(result.samplers)
        # Nothing is significantly closer to exact draws than exact draws.
        if "exact" not in advice.without_draws:
            assert "exact" in best


def test_command_prints_the_advice(capsys):
    assert main(["which", "gait"]) == 0
    assert capsys.readouterr().out.strip() == str(advise("gait"))
    assert main(["which"]) == 0
    assert capsys.readouterr().out.count("\nranked by: ") == len(problem_names())
    assert main(["which", "gate"]) == 2
    assert "problem must be one of gait, " in capsys.readouterr().err

"""Advice says what the measurements say, with their figures, and nothing that they do not."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from probmotion.cli.main import main
from probmotion.comparison import advise, compare, measured
from probmotion.comparison.measurements import Measured, save_measurements
from probmotion.posteriors.sampling import sampler_names
from probmotion.problems import load_problem, problem_names
from probmotion.samplers import ExactSampler, ScoreDistillation


def made(measure="swd_ratio", seconds=None, more=(), **values):
    """Measurements of one problem, three seeds."""
    seconds = {name: 6.0 for name in values} | (seconds or {})
    rows = [
        ("p", name, seed, metric, value)
        for name, each in values.items()
        for seed, quality in enumerate(each)
        for metric, value in ((measure, quality), ("seconds", seconds[name]))
    ]
    rows += [("p", name, seed, metric, value) for name, metric, value in more for seed in range(3)]
    return Measured(
        pd.DataFrame(rows, columns=["problem", "sampler", "seed", "metric", "value"]),
        "made here",
        40,
        3,
        1.3,
        ["all had 6 seconds"],
        {"p": "a problem"},
        [*values, "sds"],
        {"p/sds": "observations"},
    )


NEAR, ALIKE, FAR = [1.0, 1.02, 0.97], [1.03, 0.99, 1.05], [2.0, 2.1, 2.05]


def test_the_best_is_taken_and_the_others_are_told_from_it_or_not():
    found = advise("p", made(near=NEAR, far=FAR, alike=ALIKE, farther=[3.0, 3.1, 3.05]))
    assert found.take.sampler == "near"
    assert found.take.value == pytest.approx(sum(NEAR) / 3)
    assert [each.sampler for each in found.alike] == ["alike"]
    assert [each.sampler for each in found.worse] == ["far", "farther"]
    assert found.without == {"sds": "observations"}
    text = str(found)
    assert "take: near 0.997 ± 0.025 in 6 s" in text
    assert "worse: far 2.05 ± 0.05 in 6 s (far from reference draws: swd 2.05); farther" in text
    assert "without draws: sds (evidence)" in text
    assert "40 draws, 3 seeds, all had 6 seconds (made here)" in text
    assert max(map(len, text.splitlines())) <= 100


def test_what_is_as_good_in_less_than_half_the_time_is_taken():
    values = {"near": NEAR, "alike": ALIKE, "far": FAR}
    quick = advise("p", made(seconds={"alike": 2.9, "far": 0.1}, **values))
    assert quick.take.sampler == "alike"
    assert [each.sampler for each in quick.alike] == ["near"]
    assert advise("p", made(seconds={"alike": 3.1}, **values)).take.sampler == "near"


def test_a_ratio_of_half_is_as_wrong_as_of_double():
    far = {"quarter": [0.25, 0.26, 0.24], "half": [0.5, 0.51, 0.49], "thrice": [3.0, 3.1, 2.9]}
    found = advise("p", made(near=NEAR, **far))
    assert [each.sampler for each in found.worse] == ["half", "thrice", "quarter"]


@pytest.mark.parametrize(
    ("metric", "value", "said"),
    [
        ("variance_ratio", 0.5, "spread wrong: trace of covariance 0.5 of the references'"),
        ("variance_ratio", 1.6, "spread wrong: trace of covariance 1.6 of the references'"),
        ("off_manifold_ratio", 3.0, "variance off the prior's manifold 3 of the references'"),
        ("c2st", 0.9, "a classifier tells its draws from reference ones: C2ST 0.9"),
        ("mode_proportions_tv", 0.4, "styles' shares wrong by 0.4"),
        ("rhat", 1.4, "chains do not agree: R-hat 1.4"),
    ],
)
def test_what_tells_against_a_sampler_is_said_with_its_figure(metric, value, said):
    usual = [("a", metric, {"mode_proportions_tv": 0.0, "c2st": 0.5}.get(metric, 1.0))]
    slightly = [1.2, 1.21, 1.19]
    found = advise("p", made(a=NEAR, b=slightly, more=[*usual, ("b", metric, value)]))
    assert found.take.warnings == ()
    assert found.worse[0].warnings == (said,)
    assert f"b 1.2 ± 0.01 in 6 s ({said})" in " ".join(str(found).split())


@pytest.mark.parametrize(
    ("rhat", "said"),
    [
        ([1.1, 1.1, 1.4], ()),
        ([1.1, 1.4, 1.6], ("chains do not agree at 2 of 3 seeds: R-hat 1.5",)),
        ([1.4, 1.4, 1.4], ("chains do not agree: R-hat 1.4",)),
    ],
)
def test_chains_that_do_not_agree_are_no_chance_where_more_seeds_say_so(rhat, said):
    """Of mixed chains one in 20 is above the limit: one of three seeds is, in 14 of 100 tables."""
    found = made(b=[1.2, 1.21, 1.19])
    rows = [("p", "b", seed, "rhat", value) for seed, value in enumerate(rhat)]
    more = pd.DataFrame(rows, columns=found.rows.columns)
    assert advise("p", replace(found, rows=pd.concat([found.rows, more]))).take.warnings == said


def test_what_something_tells_against_is_taken_only_if_there_is_nothing_else():
    doubtful = [("near", "rhat", 2.0)]
    found = advise("p", made(near=NEAR, alike=ALIKE, more=doubtful))
    assert (found.take.sampler, found.alike, found.doubtful[0].sampler) == ("alike", (), "near")
    assert "but: near 0.997 ± 0.025 in 6 s (chains do not agree: R-hat 2)" in " ".join(
        str(found).split()
    )
    alone = advise("p", made(near=NEAR, far=FAR, more=doubtful))
    assert alone.take.sampler == "near"
    assert "none is right at this cost; nearest: near 0.997" in str(alone)
    assert "none is right at this cost; nearest: far 2.05" in str(advise("p", made(far=FAR)))


def test_with_one_sampler_there_is_no_more_to_say():
    found = advise("p", made("fid", only=NEAR))
    assert (found.take.sampler, found.alike, found.worse) == ("only", (), ())
    assert "as good, as far as can be told: none" in str(found)


def test_seeds_without_draws_are_told_and_a_sampler_without_numbers_is_none():
    nan = float("nan")
    found = advise("p", made(near=NEAR, some=[1.0, nan, nan], none=[nan, nan, nan]))
    assert found.take.sampler == "near"
    assert [each.warnings for each in found.doubtful] == [("draws at 1 of 3 seeds",)]
    assert "nan" not in str(found)


def test_a_problem_that_was_not_measured_is_refused():
    with pytest.raises(ValueError, match="problem is 'q', expected one that was measured: p; of"):
        advise("q", made(a=NEAR))


def test_what_a_comparison_finds_is_kept_and_read(tmp_path):
    problem = load_problem("gait", frames=4)
    asked = {"exact": ExactSampler(), "sds": ScoreDistillation(iterations=3)}
    comparison = compare(problem, asked, draws=12, chains=2, seeds=2, workers=0, progress=False)
    save_measurements(comparison, "a test", tmp_path)
    found = measured(tmp_path)
    assert (found.command, found.draws, found.seeds) == ("a test", 12, 2)
    assert found.rhat_at_most > 1.1
    assert found.samplers == ["exact", "sds"]
    table = comparison.table()
    swd = table[table["metric"] == "swd_ratio"]["value"].mean()
    kept = found.rows[found.rows["metric"] == "swd_ratio"]["value"].mean()
    assert kept == pytest.approx(swd, rel=1e-4)
    assert advise(problem.name, found).take.sampler == "exact"


def test_what_ships_was_measured_of_every_sampler_on_every_problem():
    found = measured()
    assert list(found.problems) == problem_names()
    assert found.samplers == sampler_names()
    for problem in found.problems:
        advice = advise(problem)
        named = [advice.take, *advice.alike, *advice.doubtful, *advice.worse]
        told = {each.sampler for each in named} | set(advice.without)
        assert told == set(found.samplers)
        # Nothing is nearer to exact draws than they are, but by chance.
        if "exact" not in advice.without:
            assert "exact" in {each.sampler for each in (advice.take, *advice.alike)}


def test_the_command_prints_it(capsys):
    assert main(["which", "gait"]) == 0
    told = capsys.readouterr().out
    assert told.strip() == str(advise("gait"))
    assert main(["which"]) == 0
    assert capsys.readouterr().out.count("\nranked by: ") == len(problem_names())
    assert main(["which", "gate"]) == 2
    assert "expected one that was measured: gait, " in capsys.readouterr().err

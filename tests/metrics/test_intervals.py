"""What is called a difference: coverage of the intervals, and marks with a known answer."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from probmotion.metrics.intervals import best_and_tied, t_interval

REPEATS = 1000


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def share_bounds(p, n=REPEATS):
    """Four standard errors of a share around p."""
    reach = 4 * math.sqrt(p * (1 - p) / n)
    return p - reach, p + reach


@pytest.mark.parametrize("level", [0.5, 0.95])
@pytest.mark.parametrize("n", [2, 3, 10])
def test_the_interval_holds_the_mean_as_often_as_it_says(rng, n, level):
    held = 0
    for _ in range(REPEATS):
        low, high = t_interval(rng.normal(3, 2, n), level)
        held += low <= 3 <= high
    low, high = share_bounds(level)
    assert low < held / REPEATS < high


def test_the_interval_of_differences_is_that_of_scipys_paired_test(rng):
    a, b = rng.normal(size=(2, 6))
    expected = stats.ttest_rel(a, b).confidence_interval(0.9)
    assert t_interval(a - b, 0.9) == pytest.approx(tuple(expected), rel=1e-12)


def test_one_value_has_no_spread_to_be_seen():
    assert t_interval([2.0]) == (-math.inf, math.inf)


@pytest.mark.parametrize(
    ("values", "level", "match"),
    [
        ([], 0.95, r"values must be at least one, got \[\]"),
        ([1.0, math.nan], 0.95, r"values is \[1.0, nan\], expected at least one, all finite"),
        ([1.0, 2.0], 1.0, "level must be a number between 0 and 1, got 1.0"),
        ([[1.0, 2.0]], 0.95, r"values must have shape \(n\), got \(1, 2\)"),
    ],
)
def test_the_interval_says_what_is_wrong(values, level, match):
    with pytest.raises(ValueError, match=match):
        t_interval(values, level)


def test_of_two_equals_one_is_called_best_alone_once_in_twenty(rng):
    alone = 0
    for _ in range(REPEATS):
        shared = rng.normal(size=5)
        rows = {name: shared + rng.normal(size=5) for name in "ab"}
        alone += len(best_and_tied(rows, target=None)[1]) == 1
    low, high = share_bounds(0.05)
    assert low < alone / REPEATS < high


def test_the_truly_best_of_many_is_seldom_left_out(rng):
    # Equal to all but one of the others: the hardest case.
    left_out = alone = 0
    for _ in range(400):
        rows = {str(i): rng.normal(5.0 if i == 4 else 0.0, 1, 4) for i in range(5)}
        _, tied = best_and_tied(rows, target=None)
        left_out += "0" not in tied
        alone += len(tied) == 1
    assert left_out / 400 < share_bounds(0.05, 400)[1]
    assert alone / 400 < share_bounds(0.05, 400)[1]


def test_pairing_sees_what_the_spread_of_seeds_would_hide(rng):
    # Differences .1 ± .01 between samplers, seeds ± 10 apart.
    hard = rng.normal(0, 10, 6)
    rows = {"good": hard, "bad": hard + 0.1 + rng.normal(0, 0.01, 6)}
    assert best_and_tied(rows, target=None) == ("good", {"good"})
    unpaired = {"good": hard, "bad": rng.permutation(rows["bad"])}
    assert best_and_tied(unpaired, target=None)[1] == {"good", "bad"}


def test_holms_levels_by_hand():
    # Differences with mean 1 and spread s over 4 seeds: t = 2/s, two-sided p from 3 degrees.
    def shaped(p):
        spread = 2 / stats.t.isf(p / 2, 3)
        return 1 + spread * np.array([-1.0, -1.0, 1.0, 1.0]) / math.sqrt(4 / 3)

    best = np.zeros(4)
    # .02 < .05/2, then .04 < .05: both are out; with .03 first, neither is.
    both = {"best": best, "b": shaped(0.02), "c": shaped(0.04)}
    assert best_and_tied(both, target=None) == ("best", {"best"})
    neither = {"best": best, "b": shaped(0.03), "c": shaped(0.04)}
    assert best_and_tied(neither, target=None) == ("best", {"best", "b", "c"})
    # .06 > .05 holds the second back, whichever comes first in the mapping.
    one = {"c": shaped(0.06), "b": shaped(0.02), "best": best}
    assert best_and_tied(one, target=None) == ("best", {"best", "c"})


def test_with_one_seed_all_are_tied():
    rows = {"good": [0.0], "bad": [1e9]}
    assert best_and_tied(rows, target=None) == ("good", {"good", "bad"})


def test_equal_to_the_last_bit_is_tied_and_a_constant_difference_is_not():
    rows = {"a": [1.0, 2.0, 3.0], "b": [1.0, 2.0, 3.0], "c": [2.0, 3.0, 4.0]}
    best, tied = best_and_tied(rows, target=None)
    assert best in {"a", "b"}
    assert tied == {"a", "b"}


def test_one_step_of_rounding_at_every_seed_is_no_constant_difference():
    # The spread of two roundings to 1 is √(1/6): t = √3 · √6 is 4.24, two-sided .051 at 2 degrees.
    rows = {"a": [1.0, 2.0, 3.0], "c": [2.0, 3.0, 4.0]}
    assert 2 * stats.t.sf(math.sqrt(18), 2) == pytest.approx(0.0513, abs=1e-4)
    assert best_and_tied(rows, target=None, step=1.0)[1] == {"a", "c"}
    assert best_and_tied(rows, target=None, step=1.0, level=0.948)[1] == {"a"}
    # Of a hundred steps there is no doubt, nor where the spread is wider than roundings'.
    assert best_and_tied(rows, target=None, step=0.01)[1] == {"a"}
    wide = {"a": [1.0, 2.0, 3.0, 1.0], "c": [3.0, 8.0, 7.0, 5.0]}
    expected = stats.ttest_rel(wide["c"], wide["a"]).pvalue
    for level, tied in ((1 - 1.01 * expected, {"a"}), (1 - 0.99 * expected, {"a", "c"})):
        assert best_and_tied(wide, target=None, step=1.0, level=level)[1] == tied


@pytest.mark.parametrize(("seeds", "share"), [(2, 0.9), (3, 0.97)])
def test_shares_of_few_draws_are_seldom_called_different(rng, seeds, share):
    # Of 20 draws of all five samplers; without rounding 43 and 11 of 100 are.
    told = 0
    for _ in range(400):
        rows = {str(i): rng.binomial(20, share, seeds) / 20 for i in range(5)}
        told += len(best_and_tied(rows, target=None, lower_is_better=False, step=0.05)[1]) < 5
    assert told / 400 < 0.05


def test_what_is_best_depends_on_the_target():
    rows = {"low": [0.2, 0.201], "half": [0.5, 0.501], "right": [1.1, 1.101], "high": [1.9, 1.901]}
    assert best_and_tied(rows, target=None)[0] == "low"
    assert best_and_tied(rows, target=None, lower_is_better=False)[0] == "high"
    assert best_and_tied(rows, target=1)[0] == "right"
    assert best_and_tied({"a": [-0.1, -0.11], "b": [0.2, 0.21]}, target=0)[0] == "a"


def test_a_ratio_is_as_wrong_at_a_half_as_at_two():
    # By distance .5 is nearer to 1 than 1.9 is; by ratio it is farther.
    rows = {"half": [0.5, 0.5001], "more": [1.9, 1.9001]}
    assert best_and_tied(rows, target=1) == ("half", {"half"})
    assert best_and_tied(rows, target=1, ratio=True) == ("more", {"more"})
    doubled = {"half": [0.5, 0.6, 0.4], "double": [2.0, 1 / 0.6, 2.5]}
    assert best_and_tied(doubled, target=1, ratio=True)[1] == {"half", "double"}


def test_failed_runs_are_compared_over_the_seeds_that_both_have():
    nan = math.nan
    rows = {
        "whole": [1.0, 1.1, 0.9, 1.0],
        "part": [nan, 5.1, 4.9, 5.0],
        "lucky": [nan, nan, 0.1, nan],
        "none": [nan, nan, nan, nan],
    }
    # lucky's one seed does not make it the best, nor distinguishable; none is not in the running.
    assert best_and_tied(rows, target=None) == ("whole", {"whole", "lucky"})


def test_an_infinite_error_is_neither_best_nor_tied():
    rows = {"fits": [0.9, 1.2], "collapsed": [0.0, 0.9]}
    assert best_and_tied(rows, target=1, ratio=True) == ("fits", {"fits"})
    rows = {"fits": [-3.0, -2.0], "impossible": [-math.inf, -1.0]}
    assert best_and_tied(rows, target=0) == ("fits", {"fits"})


@pytest.mark.parametrize(
    ("rows", "options", "match"),
    [
        ({"a": [1.0], "b": [1.0, 2.0]}, {"target": None}, "different numbers of seeds: a 1, b 2"),
        ({"a": [math.nan]}, {"target": None}, "values has no sampler with a finite value"),
        ({}, {"target": None}, "values has no sampler with a finite value"),
        ({"a": [1.0]}, {"target": 0, "ratio": True}, "target must be a number above 0, got 0"),
        ({"a": [-1.0]}, {"target": 1, "ratio": True}, "values of a has -1.0, expected ratios"),
    ],
)
def test_marks_say_what_is_wrong(rows, options, match):
    with pytest.raises(ValueError, match=match):
        best_and_tied(rows, **options)

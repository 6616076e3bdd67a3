"""Coverage of confidence intervals, and ties in cases with known results."""

import math

import numpy as np
import pytest
from scipy import stats

from probmotion.metrics.intervals import best_and_tied, t_interval


def test_intervals_agree_with_scipy(rng):
    a, b = rng.normal(size=(2, 6))
    expected = stats.ttest_rel(a, b).confidence_interval(0.9)
    assert t_interval(a - b, 0.9) == pytest.approx(tuple(expected), rel=1e-12)
    assert t_interval([2.0]) == (-math.inf, math.inf)


def test_the_truly_best_is_rarely_excluded(rng):
    # The hardest case: all samplers but one are equally good.
    excluded = unique = 0
    for _ in range(400):
        rows = {str(i): rng.normal(5.0 if i == 4 else 0.0, 1, 4) for i in range(5)}
        _, tied = best_and_tied(rows, target=None)
        excluded += "0" not in tied
        unique += len(tied) == 1
    # Each rate is at most 5 %, plus four standard errors.
    assert max(excluded, unique) / 400 < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 400)


def test_holms_levels_by_hand():
    # Differences of mean 1 and standard deviation s over 4 seeds have t = 2/s, 3 d.o.f.
    def differing(p):
        spread = 2 / stats.t.isf(p / 2, 3)
        return 1 + spread * np.array([-1.0, -1.0, 1.0, 1.0]) / math.sqrt(4 / 3)

    best = np.zeros(4)
    # Since .02 < .05/2 and .04 < .05, both are worse; with .03 first, neither is.
    both = {"best": best, "b": differing(0.02), "c": differing(0.04)}
    assert best_and_tied(both, target=None) == ("best", {"best"})
    neither = {"best": best, "b": differing(0.03), "c": differing(0.04)}
    assert best_and_tied(neither, target=None) == ("best", {"best", "b", "c"})
    # The p-value .06 exceeds .05 for any order of the mapping.
    one = {"c": differing(0.06), "b": differing(0.02), "best": best}
    assert best_and_tied(one, target=None) == ("best", {"best", "c"})


def test_single_seeds_and_equal_values_are_tied_and_constant_differences_are_not():
    single = {"good": [0.0], "bad": [1e9]}
    assert best_and_tied(single, target=None) == ("good", {"good", "bad"})
    rows = {"a": [1.0, 2.0, 3.0], "b": [1.0, 2.0, 3.0], "c": [2.0, 3.0, 4.0]}
    assert best_and_tied(rows, target=None)[1] == {"a", "b"}


def test_differences_of_one_rounding_step():
    # Two roundings to 1 have standard deviation √(1/6), so t = √3 · √6 = 4.24 and p = .051.
    rows = {"a": [1.0, 2.0, 3.0], "c": [2.0, 3.0, 4.0]}
    assert 2 * stats.t.sf(math.sqrt(18), 2) == pytest.approx(0.0513, abs=1e-4)
    assert best_and_tied(rows, target=None, step=1.0)[1] == {"a", "c"}
    assert best_and_tied(rows, target=None, step=1.0, level=0.948)[1] == {"a"}
    # Steps far below the difference or the standard deviation do not matter.
    assert best_and_tied(rows, target=None, step=0.01)[1] == {"a"}
    wide = {"a": [1.0, 2.0, 3.0, 1.0], "c": [3.0, 8.0, 7.0, 5.0]}
    expected = stats.ttest_rel(wide["c"], wide["a"]).pvalue
    for level, tied in ((1 - 1.01 * expected, {"a"}), (1 - 0.99 * expected, {"a", "c"})):
        assert best_and_tied(wide, target=None, step=1.0, level=level)[1] == tied


def test_the_best_depends_on_the_target():
    rows = {"low": [0.2, 0.201], "half": [0.5, 0.501], "right": [1.1, 1.101], "high": [1.9, 1.901]}
    assert best_and_tied(rows, target=None)[0] == "low"
    assert best_and_tied(rows, target=None, lower_is_better=False)[0] == "high"
    assert best_and_tied(rows, target=1)[0] == "right"
    assert best_and_tied({"a": [-0.1, -0.11], "b": [0.2, 0.21]}, target=0)[0] == "a"


def test_ratios_are_compared_on_a_log_scale():
    rows = {"half": [0.5, 0.5001], "more": [1.9, 1.9001]}
    assert best_and_tied(rows, target=1) == ("half", {"half"})
    assert best_and_tied(rows, target=1, ratio=True) == ("more", {"more"})
    doubled = {"half": [0.5, 0.6, 0.4], "double": [2.0, 1 / 0.6, 2.5]}
    assert best_and_tied(doubled, target=1, ratio=True)[1] == {"half", "double"}


def test_failed_runs_are_compared_over_common_seeds():
    nan = math.nan
    rows = {
        "complete": [1.0, 1.1, 0.9, 1.0],
        "partial": [nan, 5.1, 4.9, 5.0],
        "lucky": [nan, nan, 0.1, nan],
        "none": [nan, nan, nan, nan],
    }
    # A single seed makes a sampler neither best nor different; one without seeds is excluded.
    assert best_and_tied(rows, target=None) == ("complete", {"complete", "lucky"})


def test_infinite_errors_are_neither_best_nor_tied():
    rows = {"fits": [0.9, 1.2], "collapsed": [0.0, 0.9]}
    assert best_and_tied(rows, target=1, ratio=True) == ("fits", {"fits"})
    rows = {"fits": [-3.0, -2.0], "impossible": [-math.inf, -1.0]}
    assert best_and_tied(rows, target=0) == ("fits", {"fits"})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: t_interval([]), r"values must be one or more finite numbers, got \[\]"),
        (lambda: t_interval([1.0, math.nan]), "values must be one or more finite numbers"),
        (lambda: t_interval([1.0, 2.0], 1.0), "level must be between 0 and 1, got 1.0"),
        (lambda: t_interval([[1.0, 2.0]]), r"values must have shape \(n\), got \(1, 2\)"),
        (lambda: best_and_tied({"a": [1.0], "b": [1.0, 2.0]}, target=None), "got a 1, b 2"),
        (lambda: best_and_tied({"a": [math.nan]}, target=None), "values must contain a sampler"),
        (lambda: best_and_tied({}, target=None), "values must contain a sampler with a finite"),
        (lambda: best_and_tied({"a": [1.0]}, target=0, ratio=True), "target must be above 0 for"),
        (lambda: best_and_tied({"a": [-1.0]}, target=1, ratio=True), "at least 0, got -1.0"),
    ],
)
def test_invalid_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()

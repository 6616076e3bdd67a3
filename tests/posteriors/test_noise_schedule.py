"""Noise schedule and DDPM posterior."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.posteriors.noise_schedule import NoiseSchedule


def test_posterior_reproduces_the_forward_marginal():
    schedule = NoiseSchedule.cosine(50)
    for t in range(1, 51):
        step = schedule.posterior(t)
        now, after = schedule.alpha_bar[t], schedule.alpha_bar[t - 1]
        # Mean and variance of x_{t−1} given x₀.
        assert step.clean + step.noisy * np.sqrt(now) == pytest.approx(np.sqrt(after))
        variance = step.noisy**2 * (1 - now) + step.deviation**2
        assert variance == pytest.approx(1 - after, abs=1e-12)
    assert schedule.posterior(1).deviation == 0


def test_strided_levels_are_a_subset():
    schedule = NoiseSchedule.cosine(100)
    fewer = schedule.strided(20)
    assert fewer.steps == 20
    np.testing.assert_array_equal(fewer.alpha_bar, schedule.alpha_bar[fewer.times])
    with pytest.raises(ValueError, match="at most the schedule's 100, got 101"):
        schedule.strided(101)


def test_cosine_schedule_follows_the_formula():
    angle = (np.arange(51) / 50 + 0.008) / 1.008 * np.pi / 2
    for power in (2, 4):
        levels = NoiseSchedule.cosine(50, power=power).alpha_bar
        np.testing.assert_allclose(levels[:-1], (np.cos(angle) / np.cos(angle[0]))[:-1] ** power)
        assert levels[-1] == pytest.approx(levels[-2] / 1000)  # β ≤ 0.999


@pytest.mark.parametrize(
    ("levels", "given"),
    [
        ([0.9, 0.5], "0.9, 0.5 from level 0"),
        ([1.0, 0.5, 0.5], "0.5, 0.5 from level 1"),
        ([1.0, 0.5, 0.7, 0.1], "0.5, 0.7 from level 1"),
        ([1.0, 0.5, np.nan, 0.1], "0.5, nan from level 1"),
        ([1.0, 0.5, 0.0], "0 from level 2"),
    ],
)
def test_levels_that_do_not_fall_are_refused(levels, given):
    with pytest.raises(ValueError, match=f"decrease from 1 to a number above 0, got {given}; use"):
        NoiseSchedule(np.array(levels))


def test_levels_need_one_axis():
    with pytest.raises(ValueError, match=r"must have shape \(T \+ 1,\), got shape \(1,\)"):
        NoiseSchedule(np.array([1.0]))

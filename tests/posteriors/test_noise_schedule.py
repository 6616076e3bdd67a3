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

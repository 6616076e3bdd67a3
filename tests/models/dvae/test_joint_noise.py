"""Noise and hiding as they are asked for: shares, ranges and distributions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from probmotion import Skeleton
from probmotion.models.dvae.joint_noise import JointNoise

BODY = Skeleton(
    ["hips", "chest", "left_hand", "right_hand", "left_foot", "right_foot"], [-1, 0, 1, 1, 0, 0]
)


def test_noise_is_as_it_says():
    joints = np.zeros((400, 10, 6, 3))
    noise = JointNoise(least=0.01, most=0.08, outliers=0.5, hidden=0.0)
    noisy = noise.apply(np.random.default_rng(0), joints, BODY)
    assert noisy.seen.all()
    unit = noisy.joints / noisy.noise[..., None]
    light = noisy.tails == 0
    assert abs(light.mean() - 0.5) < 5 * 0.5 / 20
    assert stats.kstest(unit[light].ravel(), "norm").pvalue > 1e-4
    for tail, values in zip(noisy.tails[~light][:5], unit[~light], strict=False):
        assert 1 / 8 <= tail <= 1 / 2
        assert stats.kstest(values.ravel(), stats.t(1 / tail).cdf).pvalue > 1e-4
    logs = np.log(noisy.noise[:, 0, 0] / 0.01) / math.log(8)
    assert stats.kstest(logs, "uniform").pvalue > 1e-4
    hides = JointNoise(hidden=1.0).apply(np.random.default_rng(0), joints, BODY)
    assert hides.seen.any(axis=(1, 2)).all()
    assert 0.5 < hides.seen.mean() < 0.95
    clean = JointNoise.hardly_any().apply(np.random.default_rng(0), joints, BODY)
    assert clean.joints.std() == pytest.approx(5e-3, rel=0.02)
    for options, message in (
        ({"least": 0.1}, "most must be at least least=0.1, got 0.08"),
        ({"outliers": 1.5}, "outliers must be a share, 0 to 1, got 1.5"),
        ({"least": 0.0}, "least must be a finite number above 0, got 0.0"),
        ({"least": math.inf, "most": math.inf}, "least must be a finite number above 0, got inf"),
        ({"most": math.inf}, "most must be a finite number above 0, got inf"),
        ({"most": math.nan}, "most must be a finite number above 0, got nan"),
        ({"hidden": math.nan}, "hidden must be a share, 0 to 1, got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            JointNoise(**options)

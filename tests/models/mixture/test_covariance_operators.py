"""Tests of the covariances of exact denoisers as operators."""

import numpy as np
import pytest

from probmotion.geometry.cameras import Cameras
from probmotion.problems import load_problem

VIEWS = Cameras.around(np.array([0.3, 2.0]), np.array([0.3, -0.2]))


@pytest.mark.parametrize("name", ["gait", "cmu-motion"])
@pytest.mark.parametrize("views", [True, False], ids=["views", "motions"])
def test_operators_keep_their_state(name, views):
    posterior = load_problem(name).posterior
    prior = posterior.prior
    size = (posterior.frames, posterior.skeleton.n_joints)
    shape = (70, 2, *size, 2) if views else (70, *size, 3)  # several blocks
    x_t, one, other = np.random.default_rng(0).normal(size=(3, *shape))

    def covariance(points, alpha_bar):
        if views:
            return prior.view_covariance(points, alpha_bar, VIEWS)
        return prior.motion_covariance(points, alpha_bar)

    operator = covariance(x_t, 0.5)
    first = operator(one)
    assert np.abs(first).max() > 1e-3
    operator(other)
    covariance(x_t + 1, 0.1)(other)
    x_t[:] = 0
    np.testing.assert_array_equal(operator(one), first)
    assert np.abs(covariance(x_t, 1.0)(one)).max() < 1e-12
    with pytest.raises(ValueError, match="vectors must have shape"):
        operator(one[:1])

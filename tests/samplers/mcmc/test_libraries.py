"""Samplers of other libraries: the moments of a posterior that is Gaussian."""

import doctest

import numpy as np
import pytest

import probmotion as pm
from probmotion.samplers.mcmc import libraries
from probmotion.samplers.mcmc.libraries import (
    blackjax_kernel,
    emcee_sampler,
    flowmc_sampler,
    numpyro_kernel,
)


class Gaussian:
    """θ ~ N((1, −2), diag(1, .25)) as the only frame of one joint."""

    skeleton = pm.Skeleton(["pelvis", "head"], [-1, 0])
    frames, fps, dim = 1, 30.0, 2
    mean, sd = np.array([1.0, -2.0]), np.array([1.0, 0.5])

    def motion(self, theta):
        joints = np.zeros((*theta.shape[:-1], 1, 2, 3))
        joints[..., 0, 1, :2] = theta
        return joints

    def log_density(self, theta):
        return -0.5 * (((theta - self.mean) / self.sd) ** 2).sum(-1)

    def initial(self, rng, n):
        return rng.normal(self.mean, self.sd, (n, 2))


def nuts_of_blackjax(log_density):
    import blackjax

    return blackjax.nuts(log_density, 0.5, np.ones(2))


def nuts_of_numpyro(potential):
    from numpyro.infer import NUTS

    return NUTS(potential_fn=potential)


def bundle_of_flowmc(*arguments, **settings):
    from flowMC.resource_strategy_bundle.RQSpline_MALA import RQSpline_MALA_Bundle

    return RQSpline_MALA_Bundle(*arguments, **settings)


flowmc = flowmc_sampler(
    bundle_of_flowmc, n_local_steps=20, n_global_steps=20, n_training_loops=3, n_epochs=3,
    rq_spline_n_layers=2, rq_spline_hidden_units=(8, 8),
)  # fmt: skip


@pytest.mark.parametrize(
    ("library", "function"),
    [
        ("blackjax", blackjax_kernel(nuts_of_blackjax, warmup=50)),
        ("numpyro", numpyro_kernel(nuts_of_numpyro, warmup=200)),
        ("emcee", emcee_sampler(walkers=20, warmup=100)),
        pytest.param("flowMC", flowmc, marks=pytest.mark.slow),
    ],
)
def test_draws_have_the_moments_of_the_posterior(library, function):
    pytest.importorskip(library)
    posterior = pm.posterior(Gaussian())
    draws, again = (
        pm.sample(posterior, function, draws=1000, chains=1, progress=False) for _ in range(2)
    )
    theta = draws.dataset["theta"].values[0]
    assert draws.dataset.attrs["sampler"] == library.lower()
    np.testing.assert_allclose(theta.mean(axis=0), Gaussian.mean, atol=0.3)
    np.testing.assert_allclose(theta.std(axis=0), Gaussian.sd, rtol=0.25)
    np.testing.assert_array_equal(again.dataset["theta"].values[0], theta)


def test_draws_are_ordered_by_walker():
    theta = libraries._walker_by_walker(np.arange(12.0).reshape(2, 3, 2), 4)
    np.testing.assert_array_equal(theta[:, 0], [0, 2, 4, 6])


@pytest.mark.parametrize(
    ("library", "function"),
    [
        ("blackjax", "blackjax_kernel"),
        ("numpyro", "numpyro_kernel"),
        ("emcee", "emcee_sampler"),
        pytest.param("flowMC", "flowmc_sampler", marks=pytest.mark.slow),
    ],
)
def test_example(library, function):
    pytest.importorskip(library)
    (example,) = doctest.DocTestFinder().find(
        getattr(libraries, function), function, globs=vars(libraries)
    )
    assert doctest.DocTestRunner().run(example) == (0, len(example.examples))

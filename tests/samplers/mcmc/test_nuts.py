"""Tests of `NUTS`: agreement with NumPyro, gradient counts, thinning, priors in torch."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import jax
import numpy as np
import pytest
import torch

from probmotion import Joints3D, MotionPosterior, seeds
from probmotion.arrays import jax_from_torch
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers import NUTS
from probmotion.samplers.mcmc.nuts_kernel import compiled

QUICK = NUTS(warmup=60, candidates=1)


@pytest.fixture(scope="module")
def long(run):
    return run(QUICK, 130)


def test_draws_are_those_of_numpyro(posterior, two_modes, long):
    from numpyro.infer import (
        MCMC,
        NUTS as Kernel,  # noqa: N811
    )

    start = posterior.initial(seeds.generator(3, "initial", 1), 1)[0]
    with jax.enable_x64(True):
        chain = MCMC(
            Kernel(potential_fn=lambda theta: -two_modes.log_density(theta)),
            num_warmup=60,
            num_samples=130,
            progress_bar=False,
        )
        chain.run(
            seeds.jax_key(3, "chain", 1),
            init_params=jax.numpy.asarray(start),
            extra_fields=("num_steps", "accept_prob", "diverging", "energy"),
        )
        fields = chain.get_extra_fields()
        np.testing.assert_array_equal(long.dataset["theta"][1], chain.get_samples())
    density = two_modes.log_density(long.dataset["theta"].values)
    np.testing.assert_allclose(long.dataset["log_density"], density, rtol=1e-9)
    np.testing.assert_array_equal(long.dataset["n_steps"][1], fields["num_steps"])
    np.testing.assert_array_equal(long.dataset["acceptance_rate"][1], fields["accept_prob"])
    np.testing.assert_array_equal(long.dataset["diverging"][1], fields["diverging"])
    np.testing.assert_array_equal(long.dataset["energy"][1], fields["energy"])
    assert long.counts["gradient"] > long.dataset["n_steps"].values.sum() + 2
    assert not jax.config.jax_enable_x64


def test_thinning_aggregates_the_statistics(run, long):
    thinned = run(replace(QUICK, thin=3), 43).dataset
    for name in ("theta", "log_density"):
        np.testing.assert_array_equal(thinned[name], long.dataset[name][:, 2:129:3])
    for name, combine in (("acceptance_rate", np.mean), ("diverging", np.any), ("n_steps", np.sum)):
        threes = long.dataset[name].values[:, :129].reshape(2, 43, 3)
        np.testing.assert_allclose(thinned[name], combine(threes, axis=2))


@dataclass(frozen=True, eq=False)
class TorchPrior:
    """Prior that accepts NumPy and torch but not JAX, like a network."""

    prior: object
    calls: list = field(default_factory=list)
    skeleton: Skeleton = field(default_factory=lambda: Skeleton(["point"], [-1]))
    frames: int = 1
    fps: float = 20.0
    dim: int = 3

    def log_density(self, theta):
        self.calls.append(1)
        value = self.prior.log_density(torch.as_tensor(theta))
        return value.numpy() if isinstance(theta, np.ndarray) else value

    def motion(self, theta):
        return self.prior.motion(theta)

    def initial(self, rng, n):
        return self.prior.initial(rng, n)


def sample(posterior, draws, sampler=QUICK, seed=3):
    return sampler.sample(posterior, draws=draws, chains=2, seed=seed, progress=False)


def test_torch_priors_yield_the_same_draws(two_modes, long):
    prior = TorchPrior(two_modes)
    draws = sample(MotionPosterior(prior), 5)
    np.testing.assert_allclose(draws.dataset["theta"], long.dataset["theta"][:, :5], atol=1e-6)
    # Two calls probe the libraries and one compiles; the others are the counted gradients.
    assert len(prior.calls) == draws.counts["gradient"] + 3
    # Callbacks that convert large arrays have caused deadlocks in JAX.
    with jax.enable_x64(True):
        square = jax.jit(jax.grad(jax_from_torch(lambda theta: -0.5 * (theta**2).sum())))
        large = np.random.default_rng(0).normal(size=200_000)
        np.testing.assert_array_equal(square(large), -large)


def test_densities_without_a_gradient_are_refused(two_modes, mixture):
    class NumpyPrior(TorchPrior):
        def log_density(self, theta):
            return self.prior.log_density(np.asarray(theta))

    with pytest.raises(
        UnsupportedPosterior, match="nuts needs a log density that JAX or torch can differentiate"
    ) as refused:
        sample(MotionPosterior(NumpyPrior(two_modes)), 2)
    assert refused.value.word == "gradient"
    outliers = Joints3D(np.zeros((2, 2, 3)), noise=0.5, degrees_of_freedom=4.0)
    with pytest.raises(UnsupportedPosterior, match="cannot evaluate the log density: the noise is"):
        sample(MotionPosterior(mixture, outliers), 2)


def test_code_is_compiled_once_and_not_timed(two_modes):
    likelihood = Joints3D(np.zeros((1, 1, 3)), noise=1.0)
    observed = MotionPosterior(two_modes, likelihood)
    sampler = NUTS(warmup=51, max_tree_depth=1, candidates=2)
    start = time.perf_counter()
    reported = sample(observed, 1, sampler=sampler, seed=1).seconds
    assert reported < (time.perf_counter() - start) / 2
    draws = sample(observed, 9, sampler=sampler, seed=8)
    assert (draws.dataset["n_steps"] == 1).all()
    with jax.enable_x64(True):
        kernel = compiled(observed, 51, 0.8, 1)
    assert kernel.advance._cache_size() == kernel.log_likelihood._cache_size() == 1

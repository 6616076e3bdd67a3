"""`NUTS`: NumPyro's own draws, gradients counted, going on, priors that only torch can read."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import jax
import numpy as np
import pytest

from probmotion import Joints3D, MotionDraws, MotionPosterior, seeds
from probmotion.arrays import jax_from_torch
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import Interrupted, UnsupportedPosterior
from probmotion.samplers import NUTS
from probmotion.samplers.mcmc import nuts as nuts_module
from probmotion.samplers.mcmc.nuts_kernel import compiled

QUICK = NUTS(warmup=60, candidates=1)


def run(posterior, draws, chains=2, seed=3, sampler=QUICK, **more):
    return sampler.sample(
        posterior, draws=draws, chains=chains, seed=seed, **{"progress": False, **more}
    )


@pytest.fixture(scope="module")
def posterior(two_bumps):
    return MotionPosterior(two_bumps)


@pytest.fixture(scope="module")
def long(posterior):
    return run(posterior, 130)


def test_the_draws_are_numpyros_own(posterior, two_bumps, long):
    from numpyro.infer import (
        MCMC,
        NUTS as Kernel,  # noqa: N811
    )

    start = posterior.initial(seeds.generator(3, "initial", 1), 1)[0]
    with jax.enable_x64(True):
        chain = MCMC(
            Kernel(potential_fn=lambda theta: -two_bumps.log_density(theta)),
            num_warmup=60,
            num_samples=130,
            progress_bar=False,
        )
        chain.run(
            seeds.jax_key(3, "chain", 1),
            init_params=jax.numpy.asarray(start),
            extra_fields=("num_steps", "accept_prob", "diverging"),
        )
        fields = chain.get_extra_fields()
        np.testing.assert_array_equal(long.dataset["theta"][1], chain.get_samples())
    np.testing.assert_array_equal(long.dataset["steps"][1], fields["num_steps"])
    np.testing.assert_array_equal(long.dataset["acceptance"][1], fields["accept_prob"])
    np.testing.assert_array_equal(long.dataset["divergent"][1], fields["diverging"])


def test_what_is_stored_belongs_together(two_bumps, long):
    theta = long.dataset["theta"].values
    np.testing.assert_allclose(long.dataset["log_density"], two_bumps.log_density(theta))
    np.testing.assert_array_equal(long.positions.values, two_bumps.motion(theta))
    assert long.counts["gradient"] > long.dataset["steps"].values.sum() + 2


def test_going_on_is_as_if_it_had_not_stopped(posterior, long, tmp_path):
    first = run(posterior, 71)
    first.save(tmp_path / "first.nc")
    second = run(posterior, 59, initial=MotionDraws.load(tmp_path / "first.nc"))
    for name in ("theta", "positions", "log_density", "steps"):
        parts = [part.dataset[name].values for part in (first, second)]
        np.testing.assert_array_equal(np.concatenate(parts, axis=1), long.dataset[name].values)
    assert first.counts["gradient"] + second.counts["gradient"] == long.counts["gradient"]


def test_a_chain_is_the_same_beside_others_and_under_a_bar(posterior, long):
    many = run(posterior, 20, chains=4, progress=True)
    np.testing.assert_array_equal(many.dataset["theta"][:2], long.dataset["theta"][:, :20])


def test_the_users_jax_is_left_as_it_was(posterior):
    run(posterior, 1)
    assert not jax.config.jax_enable_x64
    assert jax.numpy.zeros(1).dtype == np.float32


@dataclass(frozen=True, eq=False)
class TorchBumps:
    """The two bumps as a network would be: torch inside, NumPy let in, JAX not."""

    bumps: object
    calls: list = field(default_factory=list)
    skeleton: Skeleton = field(default_factory=lambda: Skeleton(["point"], [-1]))
    frames: int = 1
    fps: float = 20.0
    dim: int = 3

    def log_density(self, theta):
        import torch

        self.calls.append(1)
        value = self.bumps.log_density(torch.as_tensor(theta))
        return value.numpy() if isinstance(theta, np.ndarray) else value

    def motion(self, theta):
        return self.bumps.motion(theta)

    def initial(self, rng, n):
        return self.bumps.initial(rng, n)


def test_a_prior_that_only_torch_reads_gives_the_same_draws(two_bumps, long):
    prior = TorchBumps(two_bumps)
    draws = run(MotionPosterior(prior), 20)
    np.testing.assert_allclose(
        draws.dataset["theta"][:, :5], long.dataset["theta"][:, :5], atol=1e-6
    )
    before = len(prior.calls)
    again = run(MotionPosterior(prior), 20)
    # Two looks at what the prior lets in and one to compile, then one call per gradient reported.
    assert len(prior.calls) - before - again.counts["gradient"] == 3


def test_the_bridge_has_torchs_value_and_gradient(two_bumps):
    import torch

    at = np.array([0.3, -0.2, 0.7])
    point = torch.tensor(at, requires_grad=True)
    value = two_bumps.log_density(point)
    value.backward()
    with jax.enable_x64(True):
        bridged = jax_from_torch(two_bumps.log_density)
        got, gradient = jax.jit(jax.value_and_grad(lambda theta: 2 * bridged(theta)))(at)
        several = jax.vmap(bridged)(np.stack([at, at + 0.1]))
    np.testing.assert_allclose(got, 2 * value.item(), rtol=1e-14)
    np.testing.assert_allclose(gradient, 2 * point.grad.numpy(), rtol=1e-14)
    np.testing.assert_allclose(several, two_bumps.log_density(np.stack([at, at + 0.1])))


def test_a_large_point_crosses_the_bridge():
    """Callbacks that convert large arrays have dead-locked JAX before."""
    with jax.enable_x64(True):
        bridged = jax.jit(jax.grad(jax_from_torch(lambda theta: -0.5 * (theta**2).sum())))
        at = np.random.default_rng(0).normal(size=200_000)
        np.testing.assert_array_equal(bridged(at), -at)


def test_a_density_without_a_gradient_is_refused(two_bumps):
    class NumpyBumps(TorchBumps):
        def log_density(self, theta):
            return self.bumps.log_density(np.asarray(theta))

    with pytest.raises(
        UnsupportedPosterior, match="nuts needs a gradient of the log density, by JAX or torch"
    ) as refused:
        run(MotionPosterior(NumpyBumps(two_bumps)), 2)
    assert refused.value.word == "gradient"


def test_latent_coordinates_under_outliers_are_refused_and_positions_are_not():
    rng = np.random.default_rng(0)
    settings = {
        "skeleton": Skeleton(["a"], [-1]),
        "fps": 30.0,
        "means": rng.normal(size=(2, 1, 1, 3)),
        "factors": rng.normal(size=(2, 1, 1, 1, 3)),
        "weights": np.array([0.5, 0.5]),
        "noise": 0.3,
        "azimuths": 2,
    }
    outliers = Joints3D(np.zeros((1, 1, 3)), noise=0.5, degrees_of_freedom=4.0)
    with pytest.raises(UnsupportedPosterior, match="nuts has no density to walk on: the noise is"):
        run(MotionPosterior(GaussianMixtureMotion(**settings), outliers), 2)
    allowed = GaussianMixtureMotion(**settings, coordinates="positions")
    shallow = NUTS(warmup=60, max_tree_depth=1)
    draws = run(MotionPosterior(allowed, outliers), 9, sampler=shallow)
    assert draws.positions.shape == (2, 9, 1, 1, 3)
    assert (draws.dataset["steps"] == 1).all()


def test_a_start_of_density_zero_is_refused(posterior):
    with pytest.raises(ValueError, match="initial has log density -inf at theta"):
        run(posterior, 2, initial=np.full((2, 3), 1e200))


def interrupt_at(monkeypatch, call):
    """Raise KeyboardInterrupt before a chunk of iterations, once."""
    calls = [0]
    advance = nuts_module._Run._advance

    def interrupted(self, state, draws, thin):
        calls[0] += 1
        if calls[0] == call:
            raise KeyboardInterrupt
        return advance(self, state, draws, thin)

    monkeypatch.setattr(nuts_module._Run, "_advance", interrupted)


def test_an_interrupt_keeps_what_all_chains_finished_and_the_run_goes_on(
    posterior, long, monkeypatch
):
    # Two chains: 2 chunks each of warm-up, one each of draws, then in the second of chain 1.
    interrupt_at(monkeypatch, 4 + 2 + 2)
    with pytest.raises(Interrupted, match="interrupted after 50 draws per chain") as stopped:
        run(posterior, 130)
    rest = run(posterior, 80, initial=stopped.value.draws)
    theta = [stopped.value.draws.dataset["theta"].values, rest.dataset["theta"].values]
    np.testing.assert_array_equal(np.concatenate(theta, axis=1), long.dataset["theta"].values)


def test_compiling_happens_once_and_no_clock_counts_it(two_bumps):
    seen = Joints3D(np.zeros((two_bumps.frames, two_bumps.skeleton.n_joints, 3)), noise=1.0)
    observed, sampler = MotionPosterior(two_bumps, seen), NUTS(warmup=51, candidates=2)
    took, told = [], []
    for seed in (1, 8):
        start = time.perf_counter()
        drawn = run(observed, 1, sampler=sampler, seed=seed)
        took.append(time.perf_counter() - start)
        told.append(drawn.seconds)
    with jax.enable_x64(True):
        kernel = compiled(replace(sampler, candidates=1), observed)
    assert kernel.advance._cache_size() == kernel.log_likelihood._cache_size() == 1
    assert told[0] < took[0] / 2


def test_thinning_keeps_every_third_and_tells_of_all(posterior, long):
    thinned = run(posterior, 43, sampler=replace(QUICK, thin=3)).dataset
    for name in ("theta", "log_density"):
        np.testing.assert_array_equal(thinned[name], long.dataset[name][:, 2:129:3])
    by_threes = {
        name: long.dataset[name].values[:, :129].reshape(2, 43, 3)
        for name in ("acceptance", "divergent", "steps")
    }
    np.testing.assert_allclose(thinned["acceptance"], by_threes["acceptance"].mean(axis=2))
    np.testing.assert_array_equal(thinned["divergent"], by_threes["divergent"].any(axis=2))
    np.testing.assert_array_equal(thinned["steps"], by_threes["steps"].sum(axis=2))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"warmup": 0}, "warmup must be an integer of at least 1, got 0"),
        ({"thin": 0}, "thin must be an integer of at least 1, got 0"),
        ({"target_acceptance": 1.0}, "target_acceptance must be a number between 0 and 1, got 1.0"),
        ({"max_tree_depth": 0}, "max_tree_depth must be an integer of at least 1, got 0"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        NUTS(**settings)

"""NumPyro's No-U-Turn kernel on a posterior's log density, compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from probmotion import seeds
from probmotion.arrays import jax_from_torch
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import NotConjugate
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior
from probmotion.samplers.densities import not_conjugate

__all__ = ["CHUNK", "NutsKernel", "compiled"]


class NutsSettings(Sampler, Protocol):
    """What is read of :class:`~probmotion.samplers.mcmc.nuts.NUTS`."""

    @property
    def warmup(self) -> int:
        """Iterations that adapt."""

    @property
    def target_acceptance(self) -> float:
        """Mean acceptance that the step size is adapted to."""

    @property
    def max_tree_depth(self) -> int:
        """Doublings of a trajectory."""


CHUNK = 50
"""Most draws in one call, between two looks at the progress bar and at Ctrl-C; and most iterations,
unless one draw takes more."""


@lru_cache(maxsize=8)
def compiled(sampler: NutsSettings, posterior: MotionPosterior) -> NutsKernel:
    """Return the kernel, compiled: that takes seconds, and serves every seed and restart."""
    return NutsKernel(sampler, posterior)


class NutsKernel:
    """NumPyro's kernel on a posterior, compiled."""

    def __init__(self, sampler: NutsSettings, posterior: MotionPosterior) -> None:
        import jax
        from numpyro.infer import NUTS as Kernel  # noqa: N811

        let_in = _bridge(sampler, posterior)
        log_density = let_in(posterior.log_density)
        self.sampler = sampler
        self.kernel = Kernel(
            potential_fn=lambda theta: -log_density(theta),
            target_accept_prob=sampler.target_acceptance,
            max_tree_depth=sampler.max_tree_depth,
        )
        # Once per chain: not worth compiling.
        self.value_and_gradient = jax.value_and_grad(lambda theta: -log_density(theta))
        self.log_likelihood = jax.jit(let_in(posterior.log_likelihood))
        self.advance = jax.jit(self._advance)
        self._compile(posterior)

    def begin(self, key: Any, theta: np.ndarray) -> Any:
        """Return NumPyro's state at ``theta``; one evaluation of the gradient."""
        potential, gradient = self.value_and_gradient(theta)
        if not np.isfinite(potential):
            raise ValueError(
                f"initial has log density {-float(potential)} at theta {theta}, expected starting "
                "points of density above 0"
            )
        return self._init(key, theta, potential, gradient)

    def log_densities(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density of points in a row: ``(n, dim) → (n,)``."""
        return np.array([-float(self.value_and_gradient(point)[0]) for point in theta])

    def log_likelihoods(self, theta: np.ndarray) -> np.ndarray:
        """Return log p(y | θ) of points in a row: ``(n, dim) → (n,)``."""
        return np.array([float(self.log_likelihood(point)) for point in theta])

    def restore(self, leaves: list[np.ndarray], theta: np.ndarray) -> Any:
        """Return the state that :meth:`leaves` was taken of; no evaluation."""
        import jax

        like = self._init(jax.random.key(0), theta, 0.0, np.zeros_like(theta))
        shapes, structure = jax.tree.flatten(like)
        restored = []
        for leaf, shape in zip(leaves, shapes, strict=True):
            if jax.dtypes.issubdtype(shape.dtype, jax.dtypes.prng_key):
                restored.append(jax.random.wrap_key_data(leaf.astype(np.uint32)))
            else:
                restored.append(jax.numpy.asarray(leaf.astype(shape.dtype)))
        return jax.tree.unflatten(structure, restored)

    def leaves(self, state: Any) -> list[np.ndarray]:
        """Return a state as arrays that netCDF can hold."""
        import jax

        out = []
        for leaf in jax.tree.leaves(state):
            if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                out.append(np.asarray(jax.random.key_data(leaf)).view(np.int32))
            else:
                out.append(np.asarray(leaf))
        return out

    def _compile(self, posterior: MotionPosterior) -> None:
        """Go through all that runs go through, so that their clocks count no compiling."""
        import jax

        theta = posterior.initial(seeds.generator(0, "compile"), 1)[0]
        if posterior.likelihood is not None:
            self.log_likelihoods(theta[None])
        state = self._init(jax.random.key(0), theta, *self.value_and_gradient(theta))
        self.advance(state, 0, 1)

    def _init(self, key: Any, theta: np.ndarray, potential: Any, gradient: Any) -> Any:
        import jax.numpy as jnp
        from numpyro.infer.util import ParamInfo

        start = ParamInfo(jnp.asarray(theta), jnp.asarray(potential), jnp.asarray(gradient))
        return self.kernel.init(key, self.sampler.warmup, start)

    def _advance(self, state: Any, draws: Any, thin: Any) -> tuple[Any, dict[str, Any]]:
        """Take at most ``CHUNK`` draws, of ``thin`` iterations each; return what each kept."""
        import jax
        import jax.numpy as jnp

        def iteration(_: Any, carry: tuple[Any, Any, Any, Any]) -> Any:
            state, accepted, divergent, steps = carry
            state = self.kernel.sample(state, (), {})
            divergent = divergent | state.diverging
            return state, accepted + state.accept_prob, divergent, steps + state.num_steps

        def draw(i: Any, carry: tuple[Any, dict[str, Any]]) -> Any:
            state, rows = carry
            none = (jnp.zeros(()), jnp.zeros((), bool), jnp.zeros((), jnp.int64))
            state, accepted, divergent, steps = jax.lax.fori_loop(
                0, thin, iteration, (state, *none)
            )
            kept = {
                "theta": state.z,
                "log_density": -state.potential_energy,
                "acceptance": accepted / thin,
                "divergent": divergent,
                "steps": steps,
            }
            return state, {name: rows[name].at[i].set(value) for name, value in kept.items()}

        empty = {
            "theta": jnp.zeros((CHUNK, *state.z.shape)),
            "log_density": jnp.zeros(CHUNK),
            "acceptance": jnp.zeros(CHUNK),
            "divergent": jnp.zeros(CHUNK, bool),
            "steps": jnp.zeros(CHUNK, jnp.int64),
        }
        return jax.lax.fori_loop(0, draws, draw, (state, empty))


def _bridge(
    sampler: NutsSettings, posterior: MotionPosterior
) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Return what makes a density a JAX function of one θ: nothing, or a way through torch.

    Raises
    ------
    UnsupportedPosterior
        If neither library can differentiate it.
    """
    import jax

    point = jax.ShapeDtypeStruct((posterior.dim,), np.float64)
    try:
        jax.eval_shape(jax.grad(posterior.log_density), point)
    except NotConjugate as error:
        raise not_conjugate(sampler, error) from error
    except Exception as refused:
        # A density that lets JAX not in may raise anything; whether torch is let in decides.
        bridged = jax_from_torch(posterior.log_density)
        try:
            theta = posterior.initial(seeds.generator(0, "probe"), 1)[0]
            jax.value_and_grad(bridged)(theta)
        except Exception:
            raise UnsupportedPosterior(
                sampler.name,
                "needs a gradient of the log density, by JAX or torch, but JAX met "
                f"{type(refused).__name__}: {str(refused).splitlines()[0]}",
                word="gradient",
            ) from refused
        return jax_from_torch
    return lambda function: function

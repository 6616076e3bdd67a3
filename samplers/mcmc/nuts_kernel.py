"""Compiled kernel of NumPyro's No-U-Turn sampler."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import jax_from_torch
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import NotConjugate
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers.densities import not_conjugate

__all__ = ["CHUNK", "NutsKernel", "compiled"]


CHUNK = 50
"""Maximum number of draws per compiled call; also of iterations, unless ``thin`` is larger."""


@lru_cache(maxsize=8)
def compiled(
    posterior: MotionPosterior, warmup: int, target_acceptance: float, max_tree_depth: int
) -> NutsKernel:
    """Return the compiled kernel, cached across seeds and continued runs."""
    return NutsKernel(posterior, warmup, target_acceptance, max_tree_depth)


class NutsKernel:
    """NumPyro's NUTS kernel for the log density of a posterior."""

    def __init__(
        self, posterior: MotionPosterior, warmup: int, target_acceptance: float, max_tree_depth: int
    ) -> None:
        from probmotion.extras import jax, numpyro

        to_jax = _to_jax(posterior)
        log_density = to_jax(posterior.log_density)
        self.warmup = warmup
        self.kernel = numpyro.infer.NUTS(
            potential_fn=lambda theta: -log_density(theta),
            target_accept_prob=target_acceptance,
            max_tree_depth=max_tree_depth,
        )
        # Not compiled, because it is evaluated once per chain.
        self.value_and_gradient = jax.value_and_grad(lambda theta: -log_density(theta))
        self.log_density = jax.jit(log_density)
        self.log_likelihood = jax.jit(to_jax(posterior.log_likelihood))
        self.advance = jax.jit(self._advance)
        # Compile all functions now to exclude compilation from measured run times.
        theta = posterior.initial(seeds.generator(0, "compile"), 1)[0]
        if posterior.likelihood is not None:
            self.log_likelihoods(theta[None])
        self.advance(self._init(jax.random.key(0), theta, *self.value_and_gradient(theta)), 0, 1)

    def begin(self, key: Any, theta: np.ndarray) -> Any:
        """Return the initial state at ``theta``; evaluates the gradient once."""
        potential, gradient = self.value_and_gradient(theta)
        if not np.isfinite(potential):
            raise ValueError(
                f"initial must have a finite log density, got {-float(potential)} at theta {theta}"
            )
        return self._init(key, theta, potential, gradient)

    def log_densities(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density: ``(n, dim) → (n,)``."""
        return np.array([float(self.log_density(point)) for point in theta])

    def log_likelihoods(self, theta: np.ndarray) -> np.ndarray:
        """Return log p(y | θ): ``(n, dim) → (n,)``."""
        return np.array([float(self.log_likelihood(point)) for point in theta])

    def restore(self, leaves: list[np.ndarray], theta: np.ndarray) -> Any:
        """Return the state with the given :meth:`leaves`, without evaluating the density."""
        from probmotion.extras import jax

        template = self._init(jax.random.key(0), theta, 0.0, np.zeros_like(theta))
        shapes, structure = jax.tree.flatten(template)
        restored = []
        for leaf, shape in zip(leaves, shapes, strict=True):
            if jax.dtypes.issubdtype(shape.dtype, jax.dtypes.prng_key):
                restored.append(jax.random.wrap_key_data(leaf.astype(np.uint32)))
            else:
                restored.append(jax.numpy.asarray(leaf.astype(shape.dtype)))
        return jax.tree.unflatten(structure, restored)

    def leaves(self, state: Any) -> list[np.ndarray]:
        """Return a state as a list of arrays that netCDF can store."""
        from probmotion.extras import jax

        out = []
        for leaf in jax.tree.leaves(state):
            if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                out.append(np.asarray(jax.random.key_data(leaf)).view(np.int32))
            else:
                out.append(np.asarray(leaf))
        return out

    def _init(self, key: Any, theta: np.ndarray, potential: Any, gradient: Any) -> Any:
        from probmotion.extras import jax, numpyro

        jnp = jax.numpy
        start = numpyro.infer.util.ParamInfo(
            jnp.asarray(theta), jnp.asarray(potential), jnp.asarray(gradient)
        )
        return self.kernel.init(key, self.warmup, start)

    def _advance(self, state: Any, draws: Any, thin: Any) -> tuple[Any, dict[str, Any]]:
        """Return the state after ``draws`` ≤ CHUNK draws, and arrays of draws with CHUNK rows."""
        from probmotion.extras import jax

        jnp = jax.numpy

        def iteration(_: Any, carry: tuple[Any, Any, Any, Any]) -> Any:
            state, accepted, diverging, steps = carry
            state = self.kernel.sample(state, (), {})
            diverging = diverging | state.diverging
            return state, accepted + state.accept_prob, diverging, steps + state.num_steps

        def draw(i: Any, carry: tuple[Any, dict[str, Any]]) -> Any:
            state, rows = carry
            zeros = (jnp.zeros(()), jnp.zeros((), bool), jnp.zeros((), jnp.int64))
            state, accepted, diverging, steps = jax.lax.fori_loop(
                0, thin, iteration, (state, *zeros)
            )
            values = {
                "theta": state.z,
                "log_density": -state.potential_energy,
                "acceptance_rate": accepted / thin,
                "diverging": diverging,
                "n_steps": steps,
                "energy": state.energy,
            }
            return state, {name: rows[name].at[i].set(value) for name, value in values.items()}

        empty = {
            "theta": jnp.zeros((CHUNK, *state.z.shape)),
            "log_density": jnp.zeros(CHUNK),
            "acceptance_rate": jnp.zeros(CHUNK),
            "diverging": jnp.zeros(CHUNK, bool),
            "n_steps": jnp.zeros(CHUNK, jnp.int64),
            "energy": jnp.zeros(CHUNK),
        }
        return jax.lax.fori_loop(0, draws, draw, (state, empty))


def _to_jax(
    posterior: MotionPosterior,
) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Return the conversion of densities to JAX: the identity, or :func:`jax_from_torch`.

    Raises :class:`UnsupportedPosterior` if neither JAX nor torch can differentiate the density.
    """
    from probmotion.extras import jax

    point = jax.ShapeDtypeStruct((posterior.dim,), np.float64)
    try:
        jax.eval_shape(jax.grad(posterior.log_density), point)
    except NotConjugate as error:
        raise not_conjugate("nuts", error) from error
    except Exception as jax_error:
        # A density that does not accept JAX arrays may raise any exception. Try torch.
        try:
            theta = posterior.initial(seeds.generator(0, "probe"), 1)[0]
            jax.value_and_grad(jax_from_torch(posterior.log_density))(theta)
        except Exception:
            raise UnsupportedPosterior(
                "nuts",
                "needs a log density that JAX or torch can differentiate, but JAX raised "
                f"{type(jax_error).__name__}: {str(jax_error).splitlines()[0]}",
                word="gradient",
            ) from jax_error
        return jax_from_torch
    return lambda function: function

"""One integer seed → named, independent generators of every library.

A generator is addressed by the path of names that leads to it (``"draw", 3, 17``), never by the
order in which generators were asked for, so that workers, batches, bars and the number of chains
cannot change what any one of them yields.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch

__all__ = ["NormalStreams", "generator", "integer", "jax_key", "sequence", "torch_generator"]

Name = str | int


def sequence(seed: int, *path: Name) -> np.random.SeedSequence:
    """Return the ``SeedSequence`` at ``path`` below ``seed``.

    Parameters
    ----------
    seed : int
        The user's one seed, at least 0.
    *path : str or int
        Names of the nodes from the root, such as ``"chain", 2``.

    Raises
    ------
    ValueError
        If ``seed`` is not an integer of at least 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed is {seed!r}, expected an integer of at least 0")
    # A string and an integer must never address the same node: each carries a tag of its kind.
    key: list[int] = []
    for name in path:
        if isinstance(name, str):
            key += [1, zlib.crc32(name.encode())]
        else:
            key += [0, int(name)]
    return np.random.SeedSequence(int(seed), spawn_key=tuple(key))


def generator(seed: int, *path: Name) -> np.random.Generator:
    """Return the NumPy generator at ``path`` below ``seed``."""
    return np.random.Generator(np.random.PCG64(sequence(seed, *path)))


def integer(seed: int, *path: Name) -> int:
    """Return the 63-bit integer at ``path`` below ``seed``, for libraries that take an integer."""
    return int(sequence(seed, *path).generate_state(1, np.uint64)[0] >> np.uint64(1))


def torch_generator(seed: int, *path: Name, device: str = "cpu") -> torch.Generator:
    """Return the torch generator at ``path`` below ``seed``."""
    import torch

    return torch.Generator(device=device).manual_seed(integer(seed, *path))


def jax_key(seed: int, *path: Name) -> Any:
    """Return the JAX key at ``path`` below ``seed``."""
    import jax

    return jax.random.key(integer(seed, *path) & 0xFFFFFFFF)


class NormalStreams:
    """Standard normal numbers for a batch of draws, one independent stream per draw.

    The ``i``-th row of every array that :meth:`normal` returns comes from the ``i``-th draw's own
    generator, so a draw does not depend on which others share its batch.

    Parameters
    ----------
    generators : list of numpy.random.Generator
        One generator per draw of the batch.
    """

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self.generators = generators

    @classmethod
    def of_draws(cls, seed: int, draws: list[tuple[int, int]]) -> NormalStreams:
        """Return the streams of ``draws``, given as pairs (chain, draw)."""
        return cls([generator(seed, "draw", chain, draw) for chain, draw in draws])

    def normal(self, *shape: int) -> np.ndarray:
        """Return the next standard normal numbers, shape ``(B, *shape)``, float64."""
        out = np.empty((len(self.generators), *shape))
        for row, rng in zip(out, self.generators, strict=True):
            rng.standard_normal(out=row)
        return out

    def uniform(self, *shape: int) -> np.ndarray:
        """Return the next numbers uniform on [0, 1), shape ``(B, *shape)``, float64."""
        out = np.empty((len(self.generators), *shape))
        for row, rng in zip(out, self.generators, strict=True):
            rng.random(out=row)
        return out

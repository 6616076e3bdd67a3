"""Named independent random generators from one integer seed, for NumPy, PyTorch and JAX.

A generator is determined by its path of names (``"draw", 3, 17``), not by the order of creation.
Draws therefore do not depend on the number of workers, batches or chains.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from probmotion.extras import torch

__all__ = [
    "NormalStreams", "RandomNumbers", "generator", "integer", "jax_key", "resumed_generator",
    "sequence", "state_words", "torch_generator",
]  # fmt: skip

Name = str | int
_INTEGERS = (int, np.integer)


class RandomNumbers(Protocol):
    """Source of random arrays whose first axis indexes draws.

    NumPy generators and :class:`NormalStreams`, with one stream per draw, satisfy this protocol.
    """

    def random(self, size: tuple[int, ...]) -> np.ndarray:
        """Return uniform random numbers on [0, 1)."""

    def standard_normal(self, size: tuple[int, ...]) -> np.ndarray:
        """Return standard normal random numbers."""


def sequence(seed: int, *path: Name) -> np.random.SeedSequence:
    """Return the ``SeedSequence`` for ``seed`` and ``path``, for example ``"chain", 2``.

    Raises
    ------
    ValueError
        If ``seed`` is not a non-negative integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, _INTEGERS) or seed < 0:
        raise ValueError(f"seed must be an integer of at least 0, got {seed!r}")
    # The type tag prevents collisions between strings and integers.
    key: list[int] = []
    for name in path:
        key += (1, zlib.crc32(name.encode())) if isinstance(name, str) else (0, int(name))
    return np.random.SeedSequence(int(seed), spawn_key=key)


def generator(seed: int, *path: Name) -> np.random.Generator:
    """Return the NumPy generator for ``seed`` and ``path``."""
    return np.random.Generator(np.random.PCG64(sequence(seed, *path)))


def state_words(rng: np.random.Generator) -> np.ndarray:
    """Return the state of a PCG64 generator as ten 32-bit words, signed for netCDF."""
    state: Any = rng.bit_generator.state
    bits = state["state"]["state"] | state["state"]["inc"] << 128
    bits |= state["uinteger"] << 256 | state["has_uint32"] << 288
    return np.frombuffer(bits.to_bytes(40, "little"), dtype="<i4").astype(np.int32)


def resumed_generator(words: np.ndarray) -> np.random.Generator:
    """Return the generator whose state is ``words`` (:func:`state_words`)."""
    bits = int.from_bytes(np.asarray(words).astype("<i4").tobytes(), "little")
    mask = (1 << 128) - 1
    source = np.random.PCG64()
    source.state = {
        "bit_generator": "PCG64",
        "state": {"state": bits & mask, "inc": bits >> 128 & mask},
        "uinteger": bits >> 256 & 0xFFFFFFFF,
        "has_uint32": bits >> 288,
    }
    return np.random.Generator(source)


def integer(seed: int, *path: Name) -> int:
    """Return the 63-bit integer for ``seed`` and ``path``, for libraries with integer seeds."""
    return int(sequence(seed, *path).generate_state(1, np.uint64)[0] >> np.uint64(1))


def torch_generator(seed: int, *path: Name) -> torch.Generator:
    """Return the torch generator for ``seed`` and ``path``, on the CPU."""
    from probmotion.extras import torch

    return torch.Generator().manual_seed(integer(seed, *path))


def jax_key(seed: int, *path: Name) -> Any:
    """Return the JAX key for ``seed`` and ``path``."""
    from probmotion.extras import jax

    return jax.random.key(integer(seed, *path) & 0xFFFFFFFF)


class NormalStreams:
    """Random numbers for a batch of draws, with one independent generator per draw.

    Row ``i`` of every returned array comes from the generator of draw ``i``, so a draw does not
    depend on the other draws of its batch.
    """

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self.generators = generators

    @classmethod
    def of_draws(cls, seed: int, draws: list[tuple[int, int]]) -> NormalStreams:
        """Return the streams of ``draws``, a list of pairs (chain, draw)."""
        return cls([generator(seed, "draw", chain, draw) for chain, draw in draws])

    def normal(self, *shape: int) -> np.ndarray:
        """Return the next standard normal random numbers, shape ``(B, *shape)``, float64."""
        return self.standard_normal((len(self.generators), *shape))

    def uniform(self, *shape: int) -> np.ndarray:
        """Return the next uniform random numbers on [0, 1), shape ``(B, *shape)``, float64."""
        return self.random((len(self.generators), *shape))

    def random(self, size: tuple[int, ...]) -> np.ndarray:
        """Return uniform numbers; the first entry of ``size`` must be the number of draws."""
        return self._filled("random", size)

    def standard_normal(self, size: tuple[int, ...]) -> np.ndarray:
        """Return normal numbers; the first entry of ``size`` must be the number of draws."""
        return self._filled("standard_normal", size)

    def _filled(self, method: str, size: tuple[int, ...]) -> np.ndarray:
        if size[:1] != (len(self.generators),):
            raise ValueError(
                f"size must begin with the number of draws, {len(self.generators)}, got {size}"
            )
        out = np.empty(size)
        for row, rng in enumerate(self.generators):
            getattr(rng, method)(out=out[row, ...])
        return out

"""Named generators: reproducibility, independence and resumption."""

import zlib
from typing import Any

import numpy as np
import pytest
from scipy import stats

from probmotion import seeds

ADDRESSES: list[tuple[Any, ...]] = [
    (), (0,), (1,), ("0",), ("1",), ("chain",), ("draw",), ("chain", 0), ("chain", 1), (0, "chain"),
    ("draw", 0), ("draw", 0, 0), ("draw", 0, 1), ("draw", 1, 0), ("draw", 10), ("draw", "10"),
    (1, 0), (0, 1), (0, 0), ("", "chain"),
    # A string differs from its CRC-32, also if the type tag 1 precedes it.
    (zlib.crc32(b"chain"),), (1, zlib.crc32(b"chain")),
]  # fmt: skip


def test_addresses_and_seeds_determine_the_stream():
    streams = {(seed, a): seeds.generator(seed, *a).random() for seed in (0, 1) for a in ADDRESSES}
    assert len(set(streams.values())) == len(streams)
    for (seed, address), number in streams.items():
        assert seeds.generator(seed, *address).random() == number
    assert seeds.integer(np.int64(4), "a") == seeds.integer(4, "a")
    assert 0 <= seeds.integer(2**100, "a") < 2**63


def test_streams_are_uncorrelated():
    """|r| √n is standard normal for each of the 231 pairs of addresses."""
    n = 2000
    numbers = [seeds.generator(0, *address).standard_normal(n) for address in ADDRESSES]
    correlation = np.corrcoef(numbers) - np.eye(len(ADDRESSES))
    assert abs(correlation).max() * np.sqrt(n) < 5
    neighbours = [seeds.generator(0, "draw", 0, draw).standard_normal() for draw in range(n)]
    assert stats.kstest(neighbours, stats.norm.cdf).pvalue > 1e-4


@pytest.mark.parametrize("seed", [-1, 1.0, True, "0", None, np.float64(2)])
def test_invalid_seeds_are_refused(seed):
    with pytest.raises(ValueError, match=r"seed must be an integer of at least 0, got .*"):
        seeds.generator(seed)


def test_torch_and_jax_generators_are_addressed_by_path():
    import jax
    import torch

    for numbers in (
        [torch.randn(3, generator=seeds.torch_generator(0, "chain", k)) for k in (1, 1, 2)],
        [jax.random.key_data(seeds.jax_key(0, "chain", k)) for k in (1, 1, 2)],
    ):
        first, repeated, other = map(np.asarray, numbers)
        np.testing.assert_array_equal(first, repeated)
        assert (first != other).any()


def test_draws_do_not_depend_on_their_batch():
    draws = [(chain, draw) for chain in range(2) for draw in range(4)]
    all_draws = seeds.NormalStreams.of_draws(9, draws)
    first, uniform, second = all_draws.normal(3, 2), all_draws.uniform(5), all_draws.normal(4)
    assert 0 <= uniform.min() <= uniform.max() < 1
    for batch in ([(1, 2)], [(1, 3), (0, 0), (1, 2)], draws[::-1]):
        streams = seeds.NormalStreams.of_draws(9, batch)
        rows = [draws.index(draw) for draw in batch]
        # Methods of a generator take the full size, whose first axis is the draws.
        np.testing.assert_array_equal(streams.standard_normal((len(batch), 3, 2)), first[rows])
        np.testing.assert_array_equal(streams.random((len(batch), 5)), uniform[rows])
        np.testing.assert_array_equal(streams.normal(4), second[rows])
    with pytest.raises(ValueError, match="size must begin with the number of draws, 8, got"):
        all_draws.standard_normal((3, 2))


@pytest.mark.parametrize("buffered", [1, 2])
def test_generators_resume_from_their_state(buffered):
    rng = seeds.generator(3, "chain", 1)
    rng.random(5)
    rng.integers(0, 10, buffered, dtype=np.uint32)  # an odd number buffers half of a 64-bit word
    words = seeds.state_words(rng)
    assert (words.shape, words.dtype) == ((10,), np.int32)
    again = seeds.resumed_generator(words.astype(np.int64))
    expected = rng.integers(0, 2**32, 9, dtype=np.uint32)
    np.testing.assert_array_equal(again.integers(0, 2**32, 9, dtype=np.uint32), expected)
    np.testing.assert_array_equal(again.standard_normal(50), rng.standard_normal(50))


def test_streams_are_standard_normal():
    streams = seeds.NormalStreams.of_draws(1, [(0, draw) for draw in range(100)])
    numbers = streams.normal(100)
    assert stats.kstest(numbers.ravel(), stats.norm.cdf).pvalue > 1e-4
    assert stats.kstest(numbers[:, 0], stats.norm.cdf).pvalue > 1e-4
    assert len(np.unique(numbers)) == numbers.size

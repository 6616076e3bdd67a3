"""NumPy products of spectral priors against the compiled loops and a direct sum."""

import numpy as np
import pytest

from probmotion.models.mixture import _spectral_kernels as compiled, _spectral_products as plain

K, S, L, J, n = 2, 3, 5, 4, 16
P, EDGES = 3 * J, np.array([0, 1, 3, 5])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def bases(rng):
    return rng.normal(size=(K, 2 * n * L, P)), rng.normal(size=(K, n * L, P))


def test_products_with_directions(rng):
    motions = rng.normal(size=(2 * n * L, 2 * J)), rng.normal(size=(n * L, J))
    directions = rng.normal(size=(K, 3, 2 * J, P)), rng.normal(size=(K, 3, J, P))
    means = rng.normal(size=(K, L, P))
    results = bases(rng), bases(rng)
    for module, out in zip((compiled, plain), results, strict=True):
        module.to_bases(motions, directions, means, EDGES, out)
    for expected, result in zip(*results, strict=True):
        np.testing.assert_allclose(result, expected, atol=1e-12)


def test_self_products_are_cross_products_of_a_motion_with_itself(rng):
    given, weights = bases(rng), rng.normal(size=(K, S, L, P))
    products, squares = np.empty((n, K, S, 9)), np.empty((2, n, K, S, 6))
    compiled.cross_products(given, given, weights, EDGES, products)
    for module, out in zip((compiled, plain), squares, strict=True):
        module.self_products(given, weights, EDGES, out)
        np.testing.assert_allclose(out, products[..., [0, 4, 8, 1, 2, 5]], atol=1e-11)


def test_cross_products(rng):
    left, right, weights = bases(rng), bases(rng), rng.normal(size=(K, S, L, P))
    results = np.empty((2, n, K, S, 9))
    for module, out in zip((compiled, plain), results, strict=True):
        module.cross_products(left, right, weights, EDGES, out)
    np.testing.assert_allclose(results[1], results[0], atol=1e-11)


def test_weighted_sums_are_added(rng):
    given, weights = bases(rng), rng.normal(size=(K, S, L, P))
    sums = rng.normal(size=(n, K, S, 3, 3))
    sums[:, 1] = 0
    transposed = rng.normal(size=(K, 3, 2 * P, 2 * J)), rng.normal(size=(K, 3, P, J))
    results = [(np.ones((n * L, 2 * J)), np.ones((n * L, J))) for _ in range(2)]
    for module, out in zip((compiled, plain), results, strict=True):
        module.from_bases(given, weights, sums, transposed, EDGES, out)
    for expected, result in zip(*results, strict=True):
        np.testing.assert_allclose(result, expected, atol=1e-11)

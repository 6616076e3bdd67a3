"""Conditioning of one component on any information matrices, against dense linear algebra."""

import numpy as np
import pytest

from probmotion.models.mixture.conditioning import Conditional, Information


def information_matrices(kind):
    """Return information matrices of all 5 frames and 4 joints, and the number of exceptions."""
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(5, 4, 3, 3))
    full = 5 * roots @ roots.swapaxes(-1, -2)
    if kind == "all different":
        return full, 19
    if kind == "rank 1":
        line = rng.normal(size=3)
        return np.broadcast_to(5 * np.outer(line, line), full.shape).copy(), 0
    matrices = np.broadcast_to(30 * np.eye(3), full.shape).copy()
    matrices[1:3, 2] = 0.0
    matrices[4, 0] = full[4, 0]
    return matrices, 3


@pytest.mark.parametrize("kind", ["all different", "rank 1", "isotropic with exceptions"])
def test_matches_dense_linear_algebra(make_prior, make_dense, assert_close, kind):
    prior = make_prior(components=1, azimuths=1, scales=np.ones(1), scale_weights=np.ones(1))
    (C,) = make_dense(prior).covariances
    matrices, exceptions = information_matrices(kind)
    split = Information.of(matrices)
    assert len(split.frames) == exceptions
    conditional = Conditional(prior.components.gaussians[0], split)
    precision = np.zeros_like(C)
    for entry, matrix in enumerate(matrices.reshape(-1, 3, 3)):
        precision[3 * entry : 3 * entry + 3, 3 * entry : 3 * entry + 3] = matrix
    expected = np.linalg.solve(np.eye(60) + C @ precision, C)
    shift = np.random.default_rng(2).normal(size=(7, 5, 4, 3))
    assert_close(conditional.solve(shift).reshape(7, 60), shift.reshape(7, 60) @ expected)
    assert_close(conditional.log_determinant, np.linalg.slogdet(np.eye(60) + C @ precision)[1])
    blocks = [expected[i : i + 3, i : i + 3] for i in range(0, 60, 3)]
    assert_close(conditional.marginals.reshape(20, 3, 3), blocks)
    # Draws are linear in the normals; their covariance is the sum over unit vectors.
    zero, unit = np.zeros((60, 5, 4, 3)), np.eye(60).reshape(60, 5, 4, 3)
    root = np.linalg.cholesky(C).T.reshape(60, 5, 4, 3)
    both = np.concatenate([conditional.draw(root, zero), conditional.draw(zero, unit)])
    both = both.reshape(120, 60)
    assert_close(both.T @ both, expected)

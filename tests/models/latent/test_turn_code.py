"""Gaussian codes of bone rotations."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.models.latent.turn_code import TurnCode


def test_code_has_the_moments_of_what_it_was_fitted_to() -> None:
    rng = np.random.default_rng(0)
    basis = rng.standard_normal((3, 4, 2, 3))
    turns = 0.3 + np.tensordot(rng.standard_normal((50, 3)), basis, axes=1)
    code = TurnCode.fit(turns, 10.0, 3)
    flat = turns.reshape(50, -1)
    np.testing.assert_allclose(code.mean.ravel(), flat.mean(axis=0), atol=1e-12)
    matrix = code.basis.reshape(3, -1)
    np.testing.assert_allclose(matrix.T @ matrix, np.cov(flat.T), atol=1e-10)
    z = rng.standard_normal((5, 3))
    np.testing.assert_allclose(
        code.turns(z).reshape(5, -1), code.mean.ravel() + z @ matrix, atol=1e-12
    )
    with pytest.raises(ValueError, match="at most 24"):
        TurnCode.fit(turns, 10.0, 30)

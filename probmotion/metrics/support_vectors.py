"""Support vector machine with a Gaussian kernel, for two classes.

Sequential minimal optimisation of the dual problem with second-order working sets (Fan, Chen and
Lin 2005, "Working set selection using second order information", algorithm 3). Settings are
scikit-learn's defaults, and so are predictions: kernel values are rounded to single precision, and
ties are resolved, as in LIBSVM.
"""

from __future__ import annotations

import numpy as np

__all__ = ["cross_validated_accuracy"]

_COST = 1.0  # C
_TOLERANCE = 1e-3  # of the optimality conditions
_FLAT = 1e-12  # curvature in place of one that is not positive


def cross_validated_accuracy(
    features: np.ndarray, labels: np.ndarray, n_folds: int, seed: int
) -> float:
    """Return the mean accuracy over held-out folds with equal proportions of both classes.

    Parameters
    ----------
    features : ndarray, (n, D)
        Points.
    labels : ndarray of int, (n,)
        Sorted labels 0 and 1, each at least ``n_folds`` times.
    n_folds : int
        Number of folds.
    seed : int
        Seed of the random folds, below 2³².
    """
    folds = _folds(labels, n_folds, np.random.RandomState(seed))
    accuracies = []
    for fold in range(n_folds):
        held_out = folds == fold
        predicted = _predicted(features[~held_out], labels[~held_out], features[held_out])
        accuracies.append(np.mean(predicted == labels[held_out]))
    return float(np.mean(accuracies))


def _folds(labels: np.ndarray, n_folds: int, rng: np.random.RandomState) -> np.ndarray:
    """Return the fold of each point, (n,); sorted points take turns, separately shuffled."""
    turns = np.arange(len(labels)) % n_folds
    folds = np.empty_like(turns)
    for label in (0, 1):
        chosen = np.sort(turns[labels == label])
        rng.shuffle(chosen)
        folds[labels == label] = chosen
    return folds


def _predicted(points: np.ndarray, labels: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the labels of other points, (m,), by a machine trained on labelled points."""
    variance = points.var()
    inverse_scale = 1 / (points.shape[1] * variance) if variance > 0 else 1.0
    signs = np.where(labels == 0, 1.0, -1.0)
    kernel = _kernel(points, points, inverse_scale).astype(np.float32).astype(np.float64)
    alpha, offset = _solved(kernel, signs)
    decision = _kernel(others, points, inverse_scale) @ (alpha * signs) - offset
    return np.where(decision > 0, 0, 1)


def _kernel(x: np.ndarray, y: np.ndarray, inverse_scale: float) -> np.ndarray:
    """Return exp(−‖x − y‖² γ), ``(n, D), (m, D) → (n, m)``."""
    squares = [np.einsum("nd,nd->n", points, points) for points in (x, y)]
    distances = squares[0][:, None] + squares[1] - 2 * (x @ y.T)
    # Rounding can make distances of close points negative, which large factors would amplify.
    return np.exp(-inverse_scale * np.maximum(distances, 0))


def _solved(kernel: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the dual variables α, (n,), and the offset ρ of the decision Σ α y k − ρ.

    α minimises Σ α_i α_j y_i y_j k_ij / 2 − Σ α_i subject to 0 ≤ α ≤ C and Σ α_i y_i = 0.
    """
    alpha, gradient = np.zeros(len(signs)), -np.ones(len(signs))
    while True:
        # Whether α_i y_i can grow and shrink.
        up = np.where(signs > 0, alpha < _COST, alpha > 0)
        down = np.where(signs > 0, alpha > 0, alpha < _COST)
        slopes = -signs * gradient
        pair = _working_set(kernel, slopes, up, down)
        if pair is None:
            return alpha, _offset(slopes, up, down)
        i, j = pair
        before = alpha[[i, j]]
        alpha[i], alpha[j] = _moved(kernel, signs, alpha, gradient, i, j)
        moves = (alpha[[i, j]] - before) * signs[[i, j]]
        gradient += signs * (moves[0] * kernel[i] + moves[1] * kernel[j])


def _working_set(
    kernel: np.ndarray, slopes: np.ndarray, up: np.ndarray, down: np.ndarray
) -> tuple[int, int] | None:
    """Return the points whose α y grows and shrinks; None if α is optimal.

    The first is the steepest, the second gives the largest decrease; of equal ones, the last.
    """
    rising = np.where(up, slopes, -np.inf)
    i = len(rising) - 1 - int(rising[::-1].argmax())
    differences = slopes[i] - slopes
    if differences[down].max() < _TOLERANCE:
        return None
    curvature = kernel[i, i] + kernel.diagonal() - 2 * kernel[i]
    curvature[curvature <= 0] = _FLAT
    decrease = np.where(down & (differences > 0), differences**2 / curvature, -np.inf)
    return i, len(decrease) - 1 - int(decrease[::-1].argmax())


def _moved(
    kernel: np.ndarray, signs: np.ndarray, alpha: np.ndarray, gradient: np.ndarray, i: int, j: int
) -> tuple[float, float]:
    """Return the optimal α_i and α_j with α_i y_i + α_j y_j and the other variables fixed."""
    curvature = max(kernel[i, i] + kernel[j, j] - 2 * kernel[i, j], 0.0) or _FLAT
    if signs[i] != signs[j]:
        step = (-gradient[i] - gradient[j]) / curvature
        difference = alpha[i] - alpha[j]
        # α_i must be in [max(0, difference), C + min(0, difference)].
        low, high = max(0.0, difference), min(_COST, _COST + difference)
        moved = alpha[i] + step
        if moved <= low:
            return low, low - difference if difference <= 0 else 0.0
        if moved >= high:
            return high, high - difference if difference < 0 else _COST - difference
        return moved, alpha[j] + step
    step = (gradient[i] - gradient[j]) / curvature
    total = alpha[i] + alpha[j]
    low, high = max(0.0, total - _COST), min(_COST, total)
    moved = alpha[i] - step
    if moved <= low:
        return low, total - low
    if moved >= high:
        return high, total - high
    return moved, alpha[j] + step


def _offset(slopes: np.ndarray, up: np.ndarray, down: np.ndarray) -> float:
    """Return the offset at which free variables have margin 1, or else the middle of its range."""
    free = up & down
    if free.any():
        return float(-slopes[free].mean())
    return float(-0.5 * (slopes[up].max() + slopes[down].min()))

"""Two-sample tests of independent draws: flattened motions (n, D) in metres.

Thin Markov chains first, since the tests mistake autocorrelation for a difference.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import linalg

from probmotion import seeds
from probmotion.metrics.support_vectors import cross_validated_accuracy
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = [
    "accuracy_sd",
    "classifier_two_sample",
    "discrepancy_p_value",
    "maximum_mean_discrepancy",
    "median_distance",
    "principal_components",
    "principal_coordinates",
    "squared_distances",
]

_FOLDS = 5  # of cross-validation
_MAX_COORDINATES, _POINTS_PER_COORDINATE = 40, 10  # maximum features, minimum points per feature
_ROUNDING = 1e-9  # relative rounding error
# Principal components: largest sizes for the covariance and for exact singular vectors, and
# number of additional directions of the randomised subspace.
_MAX_DIM_OF_COVARIANCE, _MAX_SIZE_OF_SVD, _OVERSAMPLING = 1000, 500, 10


def squared_distances(points: np.ndarray, centre: np.ndarray | None = None) -> np.ndarray:
    """Return pairwise squared distances, ``(n, D) → (n, n)``.

    Distances are most precise close to ``centre`` (D,), by default the mean of the points.
    """
    x = points - (points.mean(axis=0) if centre is None else centre)
    squares = np.einsum("nd,nd->n", x, x)
    distances = -2 * (x @ x.T)
    distances += squares[:, None]
    distances += squares
    np.maximum(distances, 0, out=distances)
    np.fill_diagonal(distances, 0)
    return distances


def median_distance(points: np.ndarray) -> float:
    """Return the median pairwise distance, ``(n, D) → ()``; raise ``ValueError`` if it is 0."""
    _check_set("points", points)
    return _median(squared_distances(points))


def maximum_mean_discrepancy(
    draws: np.ndarray, reference: np.ndarray, *, length_scale: float | None = None
) -> float:
    """Return the squared maximum mean discrepancy, unbiased; 0 is ideal.

    MMD² = E k(x, x') + E k(y, y') − 2 E k(x, y) with k(x, y) = exp(−‖x − y‖²/2ℓ²). E are means over
    pairs of different points (Gretton et al. 2012, eq. 3). For exact draws, the estimate has mean 0
    and may be negative; see :func:`discrepancy_p_value` for a test.

    Parameters
    ----------
    draws, reference : ndarray, (n, D) and (m, D)
        Draws to evaluate and exact draws, at least two each.
    length_scale : float, optional
        Length scale ℓ, by default the median distance of *reference* draws, which does not depend
        on the sampler (Gretton et al. 2012, section 8).
    """
    _check_sets(draws, reference)
    n = len(draws)
    # Centring on the reference preserves precision even if draws diverge.
    squared = squared_distances(np.concatenate([draws, reference]), reference.mean(axis=0))
    if length_scale is None:
        length_scale = _median(squared[n:, n:])
    check_positive("length_scale", length_scale)
    in_draws = np.zeros((n + len(reference), 1))
    in_draws[:n] = 1
    return float(_squared_discrepancies(_kernel(squared, length_scale), in_draws)[0])


def discrepancy_p_value(
    draws: np.ndarray, reference: np.ndarray, seed: int, *, permutations: int = 200
) -> float:
    """Return the permutation p-value of MMD², at least 1/(P + 1) for P permutations.

    The test is valid for independent draws (Gretton et al. 2012, section 6; Phipson and Smyth
    2010). For Markov chains, p-values are too small.

    Parameters
    ----------
    draws, reference : ndarray, (n, D) and (m, D)
        Draws to evaluate and exact draws.
    seed : int
        Seed of the permutations.
    permutations : int
        Number of permutations P.
    """
    check_count("permutations", permutations)
    _check_sets(draws, reference)
    n = len(draws)
    squared = squared_distances(np.concatenate([draws, reference]))
    # The length scale must be invariant to permutations, so it is that of both sets together.
    kernel = _kernel(squared, _median(squared))
    labels = np.zeros((len(kernel), 1 + permutations))
    labels[:n] = 1
    rng = seeds.generator(seed, "relabelling")
    labels[:, 1:] = rng.permuted(labels[:, 1:], axis=0)
    observed, *relabelled = _squared_discrepancies(kernel, labels)
    # Exchanging equal points changes the statistic only by rounding errors.
    as_large = np.asarray(relabelled) >= observed - _ROUNDING
    return float((1 + as_large.sum()) / (1 + permutations))


def classifier_two_sample(draws: np.ndarray, reference: np.ndarray, seed: int) -> float:
    """Return the accuracy of the classifier two-sample test (C2ST): 0.5 is ideal, 1 is worst.

    The classifier is a support vector machine with a Gaussian kernel
    (:mod:`~probmotion.metrics.support_vectors`); accuracy is 5-fold cross-validated (Lopez-Paz and
    Oquab 2017, section 3). For exact draws, it has mean .5 and standard deviation about 1/√(8n),
    which is .025 at n = 200.

    Features are the n/5, at most 40, leading :func:`principal_coordinates` of both sets together.

    Parameters
    ----------
    draws, reference : ndarray, both (n, D)
        Draws to evaluate and the same number of exact draws, at least 5.
    seed : int
        Seed of the folds.
    """
    _check_sets(draws, reference)
    check_shape("reference", reference, draws.shape)
    if len(draws) < _FOLDS:
        raise ValueError(f"draws must have at least {_FOLDS} points, got {len(draws)}")
    pooled = np.concatenate([draws, reference])
    size = min(_MAX_COORDINATES, len(pooled) // _POINTS_PER_COORDINATE)
    features = principal_coordinates(pooled, max(1, size))
    labels = np.repeat([0, 1], len(draws))
    return cross_validated_accuracy(features, labels, _FOLDS, seeds.integer(seed, "folds") % 2**32)


def accuracy_sd(n: int) -> float:
    """Return the standard deviation of :func:`classifier_two_sample` for equal laws, n draws each.

    Folds share training points, so that accuracies of folds are correlated. Their mean has the
    binomial variance 1/(8n) times 1 + K/(K − 1), with K folds (Nadeau and Bengio 2003, "Inference
    for the generalization error"), an approximation that errs on the side of too much.
    """
    return math.sqrt((1 + _FOLDS / (_FOLDS - 1)) / (8 * n))


def principal_coordinates(points: np.ndarray, max_coordinates: int) -> np.ndarray:
    """Return standardised principal coordinates, ``(n, D) → (n, k) or (n, k + 1)``.

    Returns up to ``max_coordinates`` leading coordinates and, if the points have more dimensions,
    the log squared distance from their subspace, to detect errors off the manifold.
    """
    if (points == points[0]).all():
        raise ValueError(f"points must differ, got {len(points)} equal points")
    centred = points - points.mean(axis=0)
    size = min(max_coordinates, *centred.shape)
    coordinates, _ = principal_components(centred, size)
    sizes = coordinates.std(axis=0)
    coordinates = coordinates[:, sizes > _ROUNDING * sizes[0]]
    features = coordinates / coordinates.std(axis=0)
    errors = (centred**2).sum(axis=1) - (coordinates**2).sum(axis=1)
    if (errors <= _ROUNDING * errors.max()).any() or errors.max() <= _ROUNDING * sizes[0] ** 2:
        return features
    errors = np.log(errors)
    return np.column_stack([features, (errors - errors.mean()) / errors.std()])


def principal_components(points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates along the k directions of largest variance, and the directions.

    ``(n, D) → (n, k), (k, D)``. The largest entry of a direction is positive. Large matrices are
    decomposed by randomised subspace iteration (Halko, Martinsson and Tropp 2011, "Finding
    structure with randomness", algorithms 4.4 and 5.1), with the settings of scikit-learn.
    """
    n, dim = points.shape
    mean = points.mean(axis=0)
    if dim <= _MAX_DIM_OF_COVARIANCE and n >= 10 * dim:
        covariance = (points.T @ points - n * mean[:, None] * mean) / (n - 1)
        directions = np.linalg.eigh(covariance)[1][:, : -k - 1 : -1].T
        directions = directions * _signs(directions)[:, None]
        return points @ directions.T - mean @ directions.T, directions
    centred = points - mean
    if max(n, dim) <= _MAX_SIZE_OF_SVD or k >= 0.8 * min(n, dim):
        left, values, right = linalg.svd(centred, full_matrices=False)
    else:
        left, values, right = _randomised_svd(centred, k)
    left, values, right = left[:, :k], values[:k], right[:k]
    signs = _signs(right)
    return left * signs * values, right * signs[:, None]


def _signs(directions: np.ndarray) -> np.ndarray:
    """Return the signs of the largest entries of directions, ``(k, D) → (k,)``."""
    largest = np.abs(directions).argmax(axis=1)
    return np.sign(directions[np.arange(len(directions)), largest])


def _randomised_svd(points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return approximate singular vectors and values, at least k."""
    n, dim = points.shape
    tall = points if n >= dim else points.T
    subspace = np.random.RandomState(0).normal(size=(tall.shape[1], k + _OVERSAMPLING))
    for _ in range(7 if k < 0.1 * min(n, dim) else 4):
        subspace, _ = linalg.lu(tall @ subspace, permute_l=True, check_finite=False)
        subspace, _ = linalg.lu(tall.T @ subspace, permute_l=True, check_finite=False)
    basis, _ = linalg.qr(tall @ subspace, mode="economic", check_finite=False)
    left, values, right = linalg.svd(basis.T @ tall, full_matrices=False)
    left = basis @ left
    return (left, values, right) if n >= dim else (right.T, values, left.T)


def _kernel(squared: np.ndarray, length_scale: float) -> np.ndarray:
    """Return the Gaussian kernel exp(−‖x − y‖²/2ℓ²), with a zero diagonal."""
    kernel = np.exp(-0.5 * squared / length_scale**2)
    np.fill_diagonal(kernel, 0)
    return kernel


def _median(squared: np.ndarray) -> float:
    median = float(np.median(squared[np.triu_indices(len(squared), 1)]))
    if median <= _ROUNDING * squared.max():
        raise ValueError("points must have a median distance above 0, got 0; most are equal")
    return math.sqrt(median)


def _squared_discrepancies(kernel: np.ndarray, in_draws: np.ndarray) -> np.ndarray:
    """Return MMD² for each column of labels, 1 for draws, 0 for reference: (n + m, P) → (P,)."""
    n = in_draws[:, 0].sum()
    m = len(kernel) - n
    to_draws = kernel @ in_draws
    within = (in_draws * to_draws).sum(axis=0)
    across = to_draws.sum(axis=0) - within
    within_reference = kernel.sum() - within - 2 * across
    return within / (n * (n - 1)) + within_reference / (m * (m - 1)) - 2 * across / (n * m)


def _check_sets(draws: np.ndarray, reference: np.ndarray) -> None:
    _check_set("draws", draws)
    _check_set("reference", reference)
    check_shape("reference", reference, ("m", draws.shape[1]))


def _check_set(name: str, points: np.ndarray) -> None:
    check_shape(name, points, ("n", "D"))
    check_finite(name, points)
    if len(points) < 2:
        raise ValueError(f"{name} must have at least 2 points, got {len(points)}")

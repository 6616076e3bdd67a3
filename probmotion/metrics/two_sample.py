"""Are two sets of draws of one distribution? Two tests that ask it without a density.

Sets are arrays (n, D): motions flattened, metres. Both tests are about *independent* draws: a
chain's neighbours are alike, which both take for a difference. Thin a chain first, or read the
numbers as what so many of its draws are worth.
"""

from __future__ import annotations

import math

import numpy as np

from probmotion import seeds
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = [
    "classifier_two_sample",
    "discrepancy_p_value",
    "maximum_mean_discrepancy",
    "median_distance",
    "principal_coordinates",
    "squared_distances",
]

_FOLDS = 5
_MOST_COORDINATES, _POINTS_PER_COORDINATE = 40, 10
_ROUNDING = 1e-9


def squared_distances(points: np.ndarray, centre: np.ndarray | None = None) -> np.ndarray:
    """Return the squared distance of every two points of a set, ``(n, D) → (n, n)``.

    They are sums of products, which lose digits far from ``centre`` (D,), the mean by default.
    """
    from sklearn.metrics import euclidean_distances

    centre = points.mean(axis=0) if centre is None else centre
    return euclidean_distances(points - centre, squared=True)


def median_distance(points: np.ndarray) -> float:
    """Return the median distance of two points of a set, ``(n, D) → ()``.

    Raises
    ------
    ValueError
        If it is 0: more than half of the pairs are of equal points.
    """
    _check_set("points", points)
    return _median(squared_distances(points))


def maximum_mean_discrepancy(
    draws: np.ndarray, reference: np.ndarray, *, length_scale: float | None = None
) -> float:
    """Return the squared maximum mean discrepancy, unbiased: 0 is right.

    MMD² = E k(x, x') + E k(y, y') − 2 E k(x, y) with k(x, y) = exp(−‖x − y‖²/2ℓ²), each mean over
    pairs of different points (Gretton et al. 2012, eq. 3). It is the square, and it may be below
    0: of exact draws its mean is 0 however many there are, whereas that of the root is not and
    falls with their number. Of two distributions it is from 0 to 2; how large it is by chance,
    :func:`discrepancy_p_value` says.

    Parameters
    ----------
    draws, reference : ndarray, (n, D) and (m, D)
        What is judged, and exact draws.
    length_scale : float, optional
        ℓ; the median distance of two *reference* draws by default (Gretton et al. 2012, section
        8), so that one ruler serves every sampler: that of the pooled sets grows with the error.

    Raises
    ------
    ValueError
        If a set has fewer than two points or one that is not finite, or the shapes disagree.
    """
    _check_sets(draws, reference)
    n = len(draws)
    # Draws that ran far away must not cost the reference its digits.
    apart = squared_distances(np.concatenate([draws, reference]), reference.mean(axis=0))
    if length_scale is None:
        length_scale = _median(apart[n:, n:])
    check_positive("length_scale", length_scale)
    in_draws = np.zeros((n + len(reference), 1))
    in_draws[:n] = 1
    return float(_squared_discrepancies(_kernel(apart, length_scale), in_draws)[0])


def discrepancy_p_value(
    draws: np.ndarray, reference: np.ndarray, seed: int, *, permutations: int = 200
) -> float:
    """Return the share of random relabellings whose MMD² is as large as that found.

    Uniform on {1, …, P + 1}/(P + 1) if both sets are independent draws of one distribution, so
    that p ≤ α has probability at most α (Gretton et al. 2012, section 6; Phipson and Smyth 2010
    for counting the labels that were found); it is never below 1/(P + 1). Draws of a chain are not
    independent: their p-values are too small.

    Parameters
    ----------
    draws, reference : ndarray, (n, D) and (m, D)
        What is judged, and exact draws.
    seed : int
        Of the relabellings.
    permutations : int
        P.

    Raises
    ------
    ValueError
        As :func:`maximum_mean_discrepancy`.
    """
    check_count("permutations", permutations)
    _check_sets(draws, reference)
    n = len(draws)
    apart = squared_distances(np.concatenate([draws, reference]))
    # The ruler must not know who is who, or relabelling would not be fair.
    kernel = _kernel(apart, _median(apart))
    labels = np.zeros((len(kernel), 1 + permutations))
    labels[:n] = 1
    rng = seeds.generator(seed, "relabelling")
    labels[:, 1:] = rng.permuted(labels[:, 1:], axis=0)
    found, *relabelled = _squared_discrepancies(kernel, labels)
    # Labels that only swap equal points give the same number but for rounding.
    as_large = np.asarray(relabelled) >= found - _ROUNDING
    return float((1 + as_large.sum()) / (1 + permutations))


def classifier_two_sample(draws: np.ndarray, reference: np.ndarray, seed: int) -> float:
    """Return how often a classifier tells draws from reference: .5 is right, 1 is worst.

    The classifier two-sample test, C2ST (Lopez-Paz and Oquab 2017, section 3): the accuracy, on
    draws that it has not learnt from, of a support vector machine with a Gaussian kernel
    (scikit-learn's, its own settings), mean over 5 folds. Of exact draws the mean is .5 and the
    standard deviation about 1/√(8n): .025 at n = 200.

    It sees :func:`principal_coordinates` of both sets together, a tenth of 2n, at most 40: motions
    have more numbers than there are draws, and small directions then count as large ones do.

    Parameters
    ----------
    draws, reference : ndarray, both (n, D)
        What is judged, and as many exact draws: else a classifier that is blind would be right
        more often than not.
    seed : int
        Of the folds.

    Raises
    ------
    ValueError
        If there are fewer than 5 draws, one is not finite, or the shapes disagree.
    """
    from sklearn.model_selection import StratifiedKFold, cross_val_score
    from sklearn.svm import SVC

    _check_sets(draws, reference)
    check_shape("reference", reference, draws.shape)
    if len(draws) < _FOLDS:
        raise ValueError(f"draws has {len(draws)} points, expected at least {_FOLDS}")
    pooled = np.concatenate([draws, reference])
    most = min(_MOST_COORDINATES, len(pooled) // _POINTS_PER_COORDINATE)
    features = principal_coordinates(pooled, max(1, most))
    labels = np.repeat([0, 1], len(draws))
    random_state = seeds.integer(seed, "folds") % 2**32
    folds = StratifiedKFold(_FOLDS, shuffle=True, random_state=random_state)
    return float(cross_val_score(SVC(), features, labels, cv=folds).mean())


def principal_coordinates(points: np.ndarray, most: int) -> np.ndarray:
    """Return the first principal coordinates of a set and what they leave, standardised.

    Parameters
    ----------
    points : ndarray, (n, D)
        The set.
    most : int
        Coordinates, at most.

    Returns
    -------
    features : ndarray, (n, k) or (n, k + 1)
        The first k principal coordinates, each of mean 0 and variance 1; last the logarithm of
        the squared distance from the subspace that they span, where the set has more dimensions:
        it tells draws that lie off the manifold, or too near, in directions that are too small to
        be among the first.

    Raises
    ------
    ValueError
        If all points are the same.
    """
    from sklearn.decomposition import PCA

    if (points == points[0]).all():
        raise ValueError(f"points are {len(points)} times the same, expected some to differ")
    apart = points - points.mean(axis=0)
    most = min(most, *apart.shape)
    coordinates = PCA(most, random_state=0).fit_transform(apart)
    sizes = coordinates.std(axis=0)
    coordinates = coordinates[:, sizes > _ROUNDING * sizes[0]]
    features = coordinates / coordinates.std(axis=0)
    rest = (apart**2).sum(axis=1) - (coordinates**2).sum(axis=1)
    if (rest <= _ROUNDING * rest.max()).any() or rest.max() <= _ROUNDING * sizes[0] ** 2:
        return features
    rest = np.log(rest)
    return np.column_stack([features, (rest - rest.mean()) / rest.std()])


def _kernel(squared: np.ndarray, length_scale: float) -> np.ndarray:
    """Return exp(−‖x − y‖²/2ℓ²), and 0 between a point and itself."""
    kernel = np.exp(-0.5 * squared / length_scale**2)
    np.fill_diagonal(kernel, 0)
    return kernel


def _median(squared: np.ndarray) -> float:
    median = float(np.median(squared[np.triu_indices(len(squared), 1)]))
    if median <= _ROUNDING * squared.max():
        raise ValueError("points have median distance 0, expected most of them to differ")
    return math.sqrt(median)


def _squared_discrepancies(kernel: np.ndarray, in_draws: np.ndarray) -> np.ndarray:
    """Return MMD² for each column of labels, 1 for draws and 0 for reference: (N, P) → (P,)."""
    n = in_draws[:, 0].sum()
    m = len(kernel) - n
    to_draws = kernel @ in_draws
    within = (in_draws * to_draws).sum(axis=0)
    across = to_draws.sum(axis=0) - within
    others = kernel.sum() - within - 2 * across
    return within / (n * (n - 1)) + others / (m * (m - 1)) - 2 * across / (n * m)


def _check_sets(draws: np.ndarray, reference: np.ndarray) -> None:
    _check_set("draws", draws)
    _check_set("reference", reference)
    check_shape("reference", reference, ("m", draws.shape[1]))


def _check_set(name: str, points: np.ndarray) -> None:
    check_shape(name, points, ("n", "D"))
    check_finite(name, points)
    if len(points) < 2:
        raise ValueError(f"{name} has {len(points)} points, expected at least 2")

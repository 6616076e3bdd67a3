"""Verdicts on the draws of a sampler: right, undecided, or wrong with the kind of error.

Draws are *right* if every quantity is shown to lie within its tolerance of the reference draws
(two one-sided tests at 5 %), *wrong* if a quantity differs significantly (Holm over quantities at
5 %) and its estimate is outside the tolerance, else *undecided*.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from probmotion import seeds
from probmotion.metrics.run_statistics import MIN_CLASSIFIED, N_SETS, DrawStatistics
from probmotion.metrics.uniformity import adjusted_p_values

__all__ = ["Quantity", "Verdict", "judge"]

_LEVEL = 0.05
_MEAN_TOLERANCE = 0.25
_RATIO_TOLERANCE = 1.25
_MODES_TOLERANCE = 0.1
_CLASSIFIER_TOLERANCE = 0.6
_DISTANCE_TOLERANCE = 1.15
_RHAT_LIMIT = 1.05

_N_SIMULATIONS = 1000
# Severity of a missing mode; the mean and the variance of the other modes differ less.
_MODE_SEVERITY = 10.0
_MAX_DRAWS = 10**7


@dataclass(frozen=True)
class Quantity:
    """One tested quantity.

    Parameters
    ----------
    name : str
        Name of the quantity.
    estimate : float
        Estimated effect; see ``ideal``.
    ideal : float
        Value of a right sampler.
    tolerance : float
        Largest acceptable value; of a ratio also the inverse of the smallest.
    p_differs : float
        p-value of the hypothesis that the effect is zero.
    p_outside : float
        p-value of the hypothesis that the effect is outside the tolerance; NaN for a quantity that
        can only show draws to be wrong.
    draws : float
        Number of draws that would decide if the estimate were true.
    """

    name: str
    estimate: float
    ideal: float
    tolerance: float
    p_differs: float
    p_outside: float
    draws: float

    @property
    def outside(self) -> bool:
        """Whether the estimate is outside the tolerance."""
        if self.ideal == 1:
            return abs(math.log(self.estimate)) > math.log(self.tolerance)
        return self.estimate > self.tolerance

    @property
    def severity(self) -> float:
        """Distance from the ideal value relative to the tolerance."""
        if self.ideal == 1:
            return abs(math.log(self.estimate)) / math.log(self.tolerance)
        return (self.estimate - self.ideal) / (self.tolerance - self.ideal)


@dataclass(frozen=True)
class Verdict:
    """Judgement of the draws of one sampler on one problem.

    Parameters
    ----------
    word : str
        ``right``, ``undecided``, ``overconfident``, ``underconfident``, ``biased``,
        ``misses modes``, ``off the manifold``, ``too smooth``, ``differs`` or ``not mixed``.
    sentence : str
        The word with its size and the reason.
    n : int
        Number of draws, effective for chains.
    quantities : tuple of Quantity
        Tested quantities.
    """

    word: str
    sentence: str
    n: int
    quantities: tuple[Quantity, ...] = ()

    @property
    def is_right(self) -> bool:
        """Whether the draws were shown to be right."""
        return self.word == "right"

    @property
    def is_wrong(self) -> bool:
        """Whether the draws were shown to be wrong."""
        return self.word not in ("right", "undecided")

    def __str__(self) -> str:
        return self.sentence


def judge(statistics: Sequence[DrawStatistics]) -> Verdict:
    """Return the verdict on the runs of one sampler on one problem, one per seed."""
    # Finished draws and deterministic samplers return the same draws for every seed.
    statistics = list({run.digest: run for run in statistics}.values())
    first = statistics[0]
    n = sum(run.n for run in statistics)
    n_draws = int(n)
    stuck = [
        run.rhat
        for run in statistics
        if run.rhat and run.rhat > max(_RHAT_LIMIT, run.rhat_by_chance)
    ]
    if stuck:
        sentence = f"not mixed: R-hat {max(stuck):.3f}, must be at most {_RHAT_LIMIT}"
        return Verdict("not mixed", sentence, n_draws)

    pooled = partial(_pooled, statistics)
    quantities = [_mean_quantity(pooled(lambda run: run.mean), pooled(lambda run: run.spread), n)]
    ratios = pooled(lambda run: list(run.ratios.values())).tolist()
    for name, (log, variance) in zip(first.ratios, ratios, strict=True):
        quantities.append(_ratio_quantity(name, log, variance, n))
    proportions = pooled(lambda run: list(run.modes.values())) if first.modes else np.empty((0, 2))
    if len(first.modes) > 1:
        quantities.append(_modes_quantity(proportions, pooled(lambda run: run.modes_spread), n))
    # Runs with few effective draws have no classifier, those with many no reference sets.
    classified = [run for run in statistics if run.classifier]
    if classified:
        accuracy, deviation = map(float, _pooled(classified, lambda run: run.classifier))
        deviation /= math.sqrt(len(classified))
        of_classified = sum(run.n for run in classified)
        quantities.append(_classifier_quantity(accuracy, deviation, of_classified))
    else:
        # Fewer draws do not suffice to be shown right.
        unknown = Quantity(
            "classifier", math.nan, 0.5, _CLASSIFIER_TOLERANCE, 1.0, 1.0, float(MIN_CLASSIFIED)
        )
        quantities.append(unknown)
    measured = [run for run in statistics if run.distance]
    if measured:
        ratio, z = map(float, _pooled(measured, lambda run: run.distance))
        p = float(stats.t.sf(z * math.sqrt(len(measured)), N_SETS - 1))
        quantities.append(
            Quantity("swd ratio", ratio, 1.0, _DISTANCE_TOLERANCE, p, math.nan, math.nan)
        )
    adjusted = adjusted_p_values(np.array([quantity.p_differs for quantity in quantities]))
    wrong = {
        quantity.name: quantity
        for quantity, p in zip(quantities, adjusted, strict=True)
        if p <= _LEVEL and quantity.outside
    }
    if wrong:
        modes = dict(zip(first.modes, proportions, strict=True))
        word, sentence = _fault(wrong, modes)
        return Verdict(word, sentence, n_draws, tuple(quantities))
    open_ = [quantity for quantity in quantities if quantity.p_outside > _LEVEL]
    if open_:
        needed = max(quantity.draws for quantity in open_)
        # Close to a tolerance, the number is too uncertain to be stated.
        about = f", about {_rounded(needed)} would decide" if needed <= 10 * n else ""
        names = " and ".join(quantity.name for quantity in open_)
        sentence = f"undecided at {n_draws} draws ({names}){about}"
        return Verdict("undecided", sentence, n_draws, tuple(quantities))
    return Verdict("right", "right", n_draws, tuple(quantities))


def _pooled(runs: Sequence[DrawStatistics], part: Callable[[DrawStatistics], Any]) -> np.ndarray:
    """Return the mean of a part of the statistics, weighted by the number of draws."""
    weights = np.array([run.n for run in runs])
    return np.tensordot(weights / weights.sum(), np.array([part(run) for run in runs], float), 1)


def _fault(wrong: Mapping[str, Quantity], modes: Mapping[str, np.ndarray]) -> tuple[str, str]:
    """Return the word and the sentence for the quantities that are wrong."""
    faults: list[tuple[float, str, str]] = []
    if "mode proportions" in wrong:
        missed = min(modes, key=lambda name: modes[name][0] - modes[name][1])
        estimated, true = modes[missed]
        sentence = f"misses modes: {missed} {estimated:.2f} of {true:.2f}"
        faults.append((_MODE_SEVERITY, "misses modes", sentence))
    if "mean" in wrong:
        mean = wrong["mean"]
        faults.append((mean.severity, "biased", f"biased by {_size(mean.estimate)} sd"))
    off = wrong.get("off-manifold")
    if off is not None and off.estimate > 1:
        faults.append(
            (off.severity, "off the manifold", f"off the manifold: variance ×{_size(off.estimate)}")
        )
    spreads = [wrong[name] for name in ("variance", "leading variance") if name in wrong]
    # Variance off the manifold is part of the total variance.
    if off is not None and off.estimate > 1:
        spreads = [spread for spread in spreads if spread.estimate < 1]
    if spreads:
        worst = max(spreads, key=lambda quantity: quantity.severity)
        word = "overconfident" if worst.estimate < 1 else "underconfident"
        size = math.exp(abs(math.log(worst.estimate)) / 2)
        faults.append((worst.severity, word, f"{word} ×{_size(size)}"))
    elif off is not None and off.estimate < 1:
        faults.append(
            (
                off.severity,
                "too smooth",
                f"too smooth: off-manifold variance ×{_size(off.estimate)}",
            )
        )
    if not faults and "classifier" in wrong:
        accuracy = wrong["classifier"].estimate
        faults.append((0, "differs", f"differs: classifier accuracy {accuracy:.0%}, not 50%"))
    if not faults:
        ratio = wrong["swd ratio"].estimate
        faults.append(
            (0, "differs", f"differs: {_size(ratio)} times the distance between exact sets")
        )
    faults.sort(key=lambda fault: -fault[0])
    return faults[0][1], " and ".join(sentence for _, _, sentence in faults)


def _mean_quantity(error: np.ndarray, spread: np.ndarray, n: float) -> Quantity:
    """Return the mean error with Hotelling's test and its noncentral form for the tolerance."""
    k = len(error)
    size = float(np.linalg.norm(error))
    freedom = n - k
    p_differs = 1.0
    if freedom > 1:
        square = n * float(error @ np.linalg.solve(spread, error))
        p_differs = float(stats.f.sf(square * freedom / (k * (n - 1)), k, freedom))
    variance = np.trace(spread) / k

    def p_outside(n: float, square: float) -> float:
        limit = n * _MEAN_TOLERANCE**2 / variance
        return float(stats.ncx2.cdf(n * square / variance, k, limit))

    true = max(0.0, size**2 - k * variance / n)

    def decides(n: float) -> bool:
        expected = true + k * variance / n
        significant = stats.chi2.sf(n * expected / variance, k) < _LEVEL
        return p_outside(n, expected) < _LEVEL or (true > _MEAN_TOLERANCE**2 and significant)

    return Quantity(
        "mean", size, 0.0, _MEAN_TOLERANCE, p_differs, p_outside(n, size**2), _deciding(decides)
    )


def _ratio_quantity(name: str, log: float, variance: float, n: float) -> Quantity:
    limit = math.log(_RATIO_TOLERANCE)
    freedom = max(1.0, n - 1)

    def p_outside(n: float) -> float:
        return float(stats.t.sf((limit - abs(log)) / math.sqrt(variance / n), freedom))

    p_differs = 2 * float(stats.t.sf(abs(log) / math.sqrt(variance / n), freedom))

    def decides(n: float) -> bool:
        significant = abs(log) > 2.6 * math.sqrt(variance / n)
        return p_outside(n) < _LEVEL or (abs(log) > limit and significant)

    return Quantity(
        name, math.exp(log), 1.0, _RATIO_TOLERANCE, p_differs, p_outside(n), _deciding(decides)
    )


def _modes_quantity(proportions: np.ndarray, spread: np.ndarray, n: float) -> Quantity:
    apart = proportions[:, 0] - proportions[:, 1]
    estimate = 0.5 * float(np.abs(apart).sum())
    rng = seeds.generator(0, "verdict modes")
    values, vectors = np.linalg.eigh(spread)
    root = vectors * np.sqrt(np.maximum(values, 0))
    noise = rng.standard_normal((_N_SIMULATIONS, len(apart))) @ root.T

    def simulated(n: float, centre: np.ndarray) -> np.ndarray:
        return 0.5 * np.asarray(np.abs(centre + noise / math.sqrt(n)).sum(axis=1))

    def p_value(counts: np.ndarray) -> float:
        return float((1 + counts.sum()) / (1 + _N_SIMULATIONS))

    def p_outside(n: float) -> float:
        return p_value(simulated(n, apart) >= _MODES_TOLERANCE)

    def decides(n: float) -> bool:
        significant = p_value(simulated(n, 0 * apart) >= estimate) < _LEVEL / 5
        return p_outside(n) < _LEVEL or (estimate > _MODES_TOLERANCE and significant)

    p_differs = p_value(simulated(n, 0 * apart) >= estimate)
    return Quantity(
        "mode proportions", estimate, 0.0, _MODES_TOLERANCE, p_differs, p_outside(n),
        _deciding(decides),
    )  # fmt: skip


def _classifier_quantity(accuracy: float, deviation: float, n: float) -> Quantity:
    p_differs = float(stats.norm.sf((accuracy - 0.5) / deviation))

    def p_outside(n_new: float) -> float:
        sd = deviation * math.sqrt(n / n_new)
        return float(stats.norm.sf((_CLASSIFIER_TOLERANCE - accuracy) / sd))

    def decides(n_new: float) -> bool:
        significant = accuracy - 0.5 > 2.6 * deviation * math.sqrt(n / n_new)
        return p_outside(n_new) < _LEVEL or (accuracy > _CLASSIFIER_TOLERANCE and significant)

    return Quantity(
        "classifier", accuracy, 0.5, _CLASSIFIER_TOLERANCE, p_differs, p_outside(n),
        _deciding(decides),
    )  # fmt: skip


def _deciding(decides: Callable[[float], bool]) -> float:
    """Return the smallest number of draws, of a geometric series, that decides."""
    n = 10.0
    while n < _MAX_DRAWS and not decides(n):
        n *= 1.2
    return n


def _size(value: float) -> str:
    """Return a number with two digits and no exponent below a million."""
    return f"{float(f'{value:.2g}'):g}"


def _rounded(n: float) -> int:
    step = 10 ** max(0, math.floor(math.log10(n)) - 1)
    return int(math.ceil(n / step) * step)

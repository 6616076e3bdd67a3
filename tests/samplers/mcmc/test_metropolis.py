"""Tests of `MetropolisHastings`: evaluation counts, starting points, continued runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import MotionDraws, MotionPosterior
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic

QUICK = MetropolisHastings(warmup=60, thin=3, candidates=1)


def test_all_chains_are_evaluated_at_once_and_counted(run, evaluations):
    draws = run(QUICK, 5, chains=4)
    assert evaluations == [4] * (1 + 60 + 5 * 3)
    assert draws.counts == {"density": sum(evaluations)}
    assert draws.dataset["acceptance_rate"].dims == ("chain", "draw")


def test_chains_start_at_initial(run):
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    static = MetropolisHastings(proposal=Isotropic(scale=1e-12, target=None), warmup=0, thin=1)
    draws = run(static, 1, initial=points)
    np.testing.assert_allclose(draws.dataset["theta"][:, 0], points, atol=1e-10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 4}, "seed must be 3, as in the run to be continued, got 4; start a new run"),
        ({"chains": 3}, "chains must be 2, as in the run to be continued, got 3"),
        ({"to": replace(QUICK, thin=4)}, "settings must be .*, as in the run .*'thin': 4"),
        ({"of": "exact"}, "sampler must be exact, as in the run to be continued, got mh"),
    ],
)
def test_runs_with_other_settings_cannot_be_continued(run, change, message):
    dataset = run(QUICK, 2).dataset
    first = MotionDraws(dataset.assign_attrs(sampler=change.pop("of", "mh")))
    with pytest.raises(ValueError, match=message):
        run(change.pop("to", QUICK), 2, initial=first, **change)


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        (np.zeros((2, 4)), r"initial must have shape \(2, 3\), got \(2, 4\)"),
        (np.full((2, 3), np.nan), "initial must be finite, got 6 values that are NaN or infinite"),
    ],
)
def test_invalid_starting_points_are_refused(run, initial, message):
    with pytest.raises(ValueError, match=message):
        run(QUICK, 2, initial=initial)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_invalid_densities_are_an_error(run, monkeypatch, bad):
    monkeypatch.setattr(
        MotionPosterior, "log_density", lambda self, theta: np.where(theta[:, 0] > -9, bad, 0.0)
    )
    with pytest.raises(ValueError, match=rf"log_density must be finite or -inf, got {bad} at thet"):
        run(QUICK, 2)

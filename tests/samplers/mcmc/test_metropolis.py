"""`MetropolisHastings`: known moments, going on, starting points, bad densities, Ctrl-C."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import MotionDraws, MotionPosterior
from probmotion.posteriors.sampling import Interrupted
from probmotion.samplers import ExactSampler, MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic

QUICK = MetropolisHastings(warmup=60, thin=3, candidates=1)


def run(posterior, draws, chains=2, seed=3, sampler=QUICK, **more):
    return sampler.sample(
        posterior, draws=draws, chains=chains, seed=seed, **{"progress": False, **more}
    )


@pytest.fixture(scope="module")
def posterior(two_bumps):
    return MotionPosterior(two_bumps)


def test_the_density_is_counted_to_the_last_evaluation(posterior, monkeypatch):
    asked = []
    monkeypatch.setattr(
        MotionPosterior,
        "log_density",
        lambda self, theta: asked.append(len(theta)) or self.prior.log_density(theta),
    )
    draws = run(posterior, 5, chains=4)
    assert draws.counts == {"density": sum(asked)}
    assert sum(asked) == 4 * (1 + 60 + 5 * 3)
    assert len(asked) == 1 + 60 + 5 * 3  # one call for all chains


def test_what_is_stored_belongs_together(posterior, two_bumps):
    draws = run(posterior, 6)
    theta = draws.dataset["theta"].values
    np.testing.assert_allclose(draws.dataset["log_density"], two_bumps.log_density(theta))
    np.testing.assert_array_equal(draws.positions.values, two_bumps.motion(theta))
    assert draws.dataset["acceptance"].dims == ("chain", "draw")
    assert not draws.independent


def test_going_on_is_as_if_it_had_not_stopped(posterior, tmp_path):
    first = run(posterior, 7)
    first.save(tmp_path / "first.nc")
    first = MotionDraws.load(tmp_path / "first.nc")
    second = run(posterior, 4, initial=first)
    second.save(tmp_path / "second.nc")
    third = run(posterior, 2, initial=MotionDraws.load(tmp_path / "second.nc"))
    whole = run(posterior, 13)
    for name in ("theta", "positions", "log_density", "acceptance"):
        parts = [part.dataset[name].values for part in (first, second, third)]
        np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole.dataset[name].values)
    assert sum(part.counts["density"] for part in (first, second, third)) == whole.counts["density"]


@pytest.mark.parametrize("name", ["theta", "acceptance"])
def test_a_chain_is_the_same_beside_others(posterior, name):
    few, many = run(posterior, 10, chains=2), run(posterior, 10, chains=5)
    # Log densities of another batch differ in rounding, and the adaptation sees it.
    np.testing.assert_allclose(few.dataset[name], many.dataset[name][:2], rtol=1e-9, atol=1e-12)


def test_a_bar_changes_nothing(posterior):
    np.testing.assert_array_equal(
        run(posterior, 5).positions, run(posterior, 5, progress=True).positions
    )


def test_chains_start_where_they_are_told(posterior):
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    still = MetropolisHastings(proposal=Isotropic(scale=1e-12, target=None), warmup=0, thin=1)
    draws = run(posterior, 1, sampler=still, initial=points)
    np.testing.assert_allclose(draws.dataset["theta"][:, 0], points, atol=1e-10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 4}, "initial is a run with seed 3, and seed is 4: a run goes on as it began"),
        ({"chains": 3}, "initial is a run with chains 2, and chains is 3"),
        ({"sampler": replace(QUICK, thin=4)}, "initial is a run with settings .* and settings is"),
    ],
)
def test_a_run_goes_on_as_it_began_or_not_at_all(posterior, change, message):
    with pytest.raises(ValueError, match=message):
        run(posterior, 2, initial=run(posterior, 2), **change)


def test_another_samplers_run_is_no_state_to_go_on_from(posterior):
    other = run(posterior, 2)
    attributes = {**other.dataset.attrs, "sampler": ExactSampler.name}
    with pytest.raises(ValueError, match="initial is a run with sampler exact, and sampler is mh"):
        run(posterior, 2, initial=MotionDraws(other.dataset.assign_attrs(attributes)))


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        (np.zeros((2, 4)), r"initial must have shape \(2, 3\), got \(2, 4\)"),
        (np.full((2, 3), np.nan), "initial must be finite, got 6 values that are NaN or infinite"),
        (np.full((2, 3), 1e200), "initial has log density -inf at point 0, expected"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow", "ignore:divide by zero")
def test_wrong_starting_points_are_refused(posterior, initial, message):
    with pytest.raises(ValueError, match=message):
        run(posterior, 2, initial=initial)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_density_that_is_no_number_stops_the_chain(posterior, monkeypatch, bad):
    monkeypatch.setattr(
        MotionPosterior, "log_density", lambda self, theta: np.where(theta[:, 0] > -9, bad, 0.0)
    )
    with pytest.raises(ValueError, match=rf"log_density is {bad} at theta .*, expected a finite"):
        run(posterior, 2)


def interrupt_after(monkeypatch, evaluations):
    """Raise KeyboardInterrupt in the middle of a step, once."""
    asked = [0]

    def log_density(self, theta):
        asked[0] += 1
        if asked[0] == evaluations:
            raise KeyboardInterrupt
        return self.prior.log_density(theta)

    monkeypatch.setattr(MotionPosterior, "log_density", log_density)


def test_an_interrupt_keeps_what_was_finished_and_the_run_goes_on(posterior, monkeypatch):
    whole = run(posterior, 10)
    interrupt_after(monkeypatch, 1 + 60 + 4 * 3 + 2)
    with pytest.raises(Interrupted, match="interrupted after 4 draws per chain") as stopped:
        run(posterior, 10)
    rest = run(posterior, 6, initial=stopped.value.draws)
    positions = [stopped.value.draws.positions.values, rest.positions.values]
    np.testing.assert_array_equal(np.concatenate(positions, axis=1), whole.positions.values)


def test_an_interrupt_of_the_warm_up_is_a_plain_one(posterior, monkeypatch):
    interrupt_after(monkeypatch, 30)
    with pytest.raises(KeyboardInterrupt) as stopped:
        run(posterior, 10)
    assert not isinstance(stopped.value, Interrupted)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"warmup": -1}, "warmup must be an integer of at least 0, got -1"),
        ({"thin": 0}, "thin must be an integer of at least 1, got 0"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        MetropolisHastings(**settings)

"""First steps: problem, sample, score, compare with functions and finished draws."""

import numpy as np
import pytest
import xarray as xr

import probmotion as pm
from probmotion.cli.main import main
from probmotion.comparison import functions
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.finished import FinishedDraws

NAME = "gait-monocular(frames=4)"


@pytest.fixture(scope="module")
def problem():
    return pm.problem(NAME)


@pytest.fixture(scope="module")
def draws(problem):
    return pm.sample(problem, "exact", draws=200, seed=0, progress=False)


def prior_draws(log_density, dim, rng, draws):
    """Draw from the prior, whatever the observations."""
    return log_density._posterior.prior.initial(rng, draws)


def test_sample_takes_names_objects_and_posteriors(problem, draws):
    again = pm.sample(problem.posterior, pm.samplers.ExactSampler(), draws=200, progress=False)
    np.testing.assert_array_equal(again.positions.values, draws.positions.values)
    assert pm.sample(NAME, "mh", draws=8, chains=2, progress=False, warmup=10).flat().shape[0] == 8


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"draws": 10, "chains": 4}, "draws must be a multiple of chains, 4, got 10"),
        ({"sampler": "nutz"}, "sampler must be one of .*, got 'nutz'; did you mean nuts"),
        ({"wide": 3}, "settings must be those of exact"),
    ],
)
def test_sample_refuses(problem, arguments, message):
    with pytest.raises(ValueError, match=message):
        pm.sample(problem, **{"progress": False} | arguments)


def test_score_prints_the_verdict_in_few_lines(problem, draws):
    score = pm.score(problem, draws)
    assert not score.verdict.is_wrong
    assert score.metrics["swd_ratio"] < 1.5
    text = str(score)
    assert text.startswith("exact on gait-monocular(frames=4): ")
    assert len(text.splitlines()) < 12
    wide = pm.score(problem, 3 * draws.positions.values)
    assert wide.verdict.is_wrong


def test_finished_draws_of_arrays_and_trees_are_the_same(problem):
    run = pm.sample(problem, "mh", draws=40, progress=False, warmup=20)
    theta = run.dataset["theta"].values
    forms = [run, run.positions.values, theta, run.to_arviz()]
    first, rest = run.dataset["theta"][..., :3], run.dataset["theta"][..., 3:]
    variables = xr.Dataset({"first": first, "rest": rest.rename(coordinate="other")})
    forms.append(xr.DataTree.from_dict({"posterior": variables}))
    scores = [pm.score(problem, form) for form in forms]
    for score in scores[1:]:
        assert score.metrics["variance_ratio"] == pytest.approx(
            scores[0].metrics["variance_ratio"], rel=0.05
        )
    flat = FinishedDraws.of(theta.reshape(-1, theta.shape[-1]), "flat")
    assert flat.sample(problem.posterior).positions.shape[:2] == (1, 40)


@pytest.mark.parametrize("bad", [3.0, "x", np.zeros(3), np.full((2, 3), np.nan), object()])
def test_other_draws_are_refused(bad):
    with pytest.raises(ValueError, match="draws must be"):
        FinishedDraws.of(bad)


def test_functions_and_finished_draws_can_be_compared(problem, draws, tmp_path):
    def broken(log_density, dim, rng, draws):
        return np.zeros((draws, dim + 1))

    def nothing(log_density, dim, rng, draws):
        return np.full((draws, dim), np.nan)

    def stops(log_density, dim, rng, draws):
        raise RuntimeError("no mode was found")

    samplers = {"exact": "exact", "stored": draws, "prior": prior_draws}
    failing = {"broken": broken, "nan": nothing, "stops": stops, "other": np.zeros((8, 3))}
    found = pm.compare(
        problem,
        samplers | failing,
        draws=200, workers=0, progress=False, out=tmp_path,
    )  # fmt: skip
    verdicts = found.verdicts()[problem.name]
    assert not verdicts["stored"].is_wrong
    assert not verdicts["exact"].is_wrong
    assert verdicts["prior"].is_wrong
    assert {verdicts[name].word for name in failing} == {"failed"}
    for name, reason in {
        "broken": "theta of broken must have shape",
        "nan": "must be finite",
        "stops": "no mode was found",
        "other": "theta must have shape",
    }.items():
        assert reason in verdicts[name].sentence
        assert "\n" not in verdicts[name].sentence
    # Since Python 3.13, data classes with NaN are not equal.
    loaded = type(found).load(tmp_path).verdicts()[problem.name]
    assert repr(loaded["stored"]) == repr(verdicts["stored"])


def test_functions_have_reproducible_chains(problem):
    def walk(log_density, dim, rng, draws):
        assert log_density(np.zeros((3, dim))).shape == (3,)
        return log_density.initial(rng, draws)

    first, second = (
        pm.sample(problem, walk, draws=20, chains=chains, progress=False) for chains in (1, 2)
    )
    assert first.dataset.attrs["sampler"] == "walk"
    np.testing.assert_array_equal(first.dataset["theta"][0, :10], second.dataset["theta"][0])
    assert first.counts["density"] == 3


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"probmotion {pm.__version__}\n"


def test_too_few_draws_and_another_shape_are_refused():
    draws = pm.problem("gait(frames=4)").reference(0, 6)
    with pytest.raises(ValueError, match="draws must contain at least 5, got 4"):
        pm.score("gait(frames=4)", draws[:4])
    with pytest.raises(ValueError, match=r"draws must have shape \(n, 5, 17, 3\), got"):
        pm.score("gait(frames=5)", pm.sample("gait(frames=4)", draws=8, progress=False))


def test_similar_names_of_problems_are_suggested():
    with pytest.raises(ValueError, match="did you mean gait"):
        pm.problem("gaitt")


def test_long_chains_are_thinned_before_they_are_scored(monkeypatch):
    draws = pm.sample("gait(frames=4)", draws=60, chains=3, progress=False)
    monkeypatch.setattr(functions, "_MAX_SCORED", 22)
    every_third = MotionDraws(draws.dataset.isel(draw=slice(None, None, 3)))
    expected = pm.score("gait(frames=4)", every_third)
    assert pm.score("gait(frames=4)", draws).metrics == expected.metrics

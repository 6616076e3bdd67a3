"""Certified references: known posteriors, rejection of wrong runs, and resumption."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from probmotion import Joints3D, Motion, MotionDraws, MotionPosterior
from probmotion.models import GaussianMixtureMotion
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors import reference as stored_references
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.reference import StoredReference
from probmotion.posteriors.sampling import load_sampler
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem
from probmotion.problems.references import making
from probmotion.problems.references.making import (
    ReferenceRefused,
    agreement,
    certify,
    make_reference,
)
from probmotion.problems.references.outlier_gibbs import OutlierGibbs


def toy(freedom=None):
    """Return a problem of two frames of one bone with noisy joints."""
    rng = np.random.default_rng(0)
    prior = GaussianMixtureMotion(
        Skeleton(["hip", "knee"], [-1, 0]),
        30.0,
        means=rng.normal(size=(2, 2, 2, 3)),
        factors=0.4 * rng.normal(size=(2, 2, 2, 2, 3)),
        weights=np.full(2, 0.5),
        noise=0.2,
        azimuths=4,
        coordinates="positions",
    )
    truth = prior.sample(rng, 1)[0]
    likelihood = Joints3D.observe(
        Motion(truth, prior.skeleton, 30.0), 0.3, 1, degrees_of_freedom=freedom
    )
    return Problem("toy", "", MotionPosterior(prior, likelihood), truth)


def widened(positions, factor):
    """Scale deviations of the second half of the draws from the mean by a factor."""
    mean, (first, second) = positions.mean(axis=0), np.split(positions, 2)
    return np.concatenate([first, mean + factor * (second - mean)])


def of_chains(*values):
    """Return one value per chain of both runs, repeated over 500 draws, (4000, 1, 1, 1)."""
    return np.repeat(np.array(values, float), 500)[:, None, None, None]


def runs_of(positions, problem):
    """Return two runs of four chains."""
    chains = positions.reshape(2, 4, -1, *positions.shape[1:])
    make = partial(MotionDraws.of, problem.posterior, OutlierGibbs(), seed=0, seconds=0.0)
    return [make(half) for half in chains]


def disk_full(*_, **__):
    raise OSError(28, "No space left on device")


@pytest.fixture(scope="module")
def exact():
    return toy()


@pytest.fixture(scope="module")
def heavy_tailed():
    return toy(freedom=3.0)


@pytest.fixture(scope="module")
def certified(exact):
    return make_reference(exact, draws=800, seed=2, progress=False)


def test_exact_problem_gets_an_exact_certificate(certified):
    values = [certified.certificate[name] for name in ("exact", "sampler", "rhat", "draws")]
    assert values == [True, "exact", None, 800]
    json.dumps(certified.certificate, allow_nan=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda drawn: drawn, None),
        (lambda drawn: widened(drawn, 0.9), "swd_ratio of two runs on toy must be at most"),
        (lambda drawn: widened(drawn, 1.1), "swd_ratio of two runs on toy must be at most"),
        (lambda drawn: drawn + 0.15 * drawn.std(axis=0) * of_chains(*"00001111"), "of two runs on"),
        (lambda drawn: drawn + 0.3 * of_chains(*"01010101"), r"R-hat .* got 1"),
    ],
    ids=["equal", "narrow", "wide", "moved", "unmixed"],
)
def test_runs_that_differ_are_refused(exact, change, message):
    drawn = exact.reference(0, 4000)
    runs = runs_of(change(drawn), exact)
    if message is None:
        certify(exact, runs, 0)
    else:
        with pytest.raises(ReferenceRefused, match=message):
            certify(exact, runs, 0)


@pytest.mark.parametrize(
    ("noise", "longer", "message"),
    [
        (0.1, "00000000", None),
        (0.1, "01010101", r"R-hat .* got 1"),
        (0.0, "00000000", "differ by more than a rigid motion"),
        (0.0, "00001111", "of two runs on toy"),
    ],
    ids=["mixed", "unmixed", "constant", "constant per run"],
)
def test_poses_are_compared_after_alignment(exact, noise, longer, message):
    """Some chains have longer bones, masked by translations of metres."""
    rng = np.random.default_rng(0)
    poses = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1.2, 1, 0]]]) * np.ones((4000, 1, 1, 1))
    poses[:, :, 1, 0] += 0.5 * of_chains(*longer)[:, 0, 0] + noise * rng.normal(size=(4000, 1))
    runs = runs_of(poses + 10 * rng.normal(size=(4000, 1, 1, 3)), exact)
    if message is None:
        assert_agreed(certify(exact, runs, 0).certificate["agreement_wherever_they_stand"])
    else:
        with pytest.raises(ReferenceRefused, match=message):
            certify(exact, runs, 0)


def assert_agreed(agreed):
    assert agreed["swd_ratio"] <= agreed["swd_ratio_at_most"]
    assert agreed["mean_z"] <= agreed["mean_z_at_most"]


def test_equal_distributions_agree():
    rng = np.random.default_rng(3)
    for _ in range(20):
        pair = rng.normal(size=(2, 4, 50, 2, 2, 3)) * np.linspace(0.1, 3, 12).reshape(2, 2, 3)
        assert_agreed(agreement(*pair, seed=0))


def test_gibbs_matches_importance_sampling(heavy_tailed):
    """The reference is importance sampling from the exact posterior with Gaussian noise."""
    posterior = heavy_tailed.posterior
    run = OutlierGibbs(thin=1).sample(posterior, draws=1000, chains=2, seed=1, progress=False)
    gaussian = replace(posterior.likelihood, degrees_of_freedom=None, noise=0.5)
    proposal = posterior.prior.exact_posterior(gaussian)
    proposed = proposal.sample(np.random.default_rng(0), 20_000)
    log_weight = heavy_tailed.log_density_of(proposed) - proposal.log_density(proposed)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    drawn = run.flat()
    for power in (1, 2):
        expected = np.einsum("n,nljx->ljx", weight, proposed**power)
        error = (drawn**power).std(axis=0) * np.sqrt(1 / 1000 + (weight**2).sum())
        assert (np.abs((drawn**power).mean(axis=0) - expected) < 5 * error).all()


def test_saved_reference_is_loaded_and_sampled(tmp_path, heavy_tailed):
    sampler = OutlierGibbs(thin=1)
    reference = make_reference(heavy_tailed, draws=480, seed=1, progress=False, sampler=sampler)
    assert (reference.n, reference.certificate["draws_made"]) == (480, 4000)
    folder = reference.save(tmp_path / "toy")
    assert {path.name for path in folder.iterdir()} == {"certificate.json", "draws.npz"}
    problem = replace(heavy_tailed, stored=StoredReference.load(folder))
    assert problem.has_reference
    assert not heavy_tailed.has_reference
    assert (problem.max_references, heavy_tailed.max_references) == (480, None)
    drawn = problem.reference(3, 480)
    np.testing.assert_array_equal(drawn, problem.reference(3, 480))
    assert len(np.unique(drawn.reshape(480, -1), axis=0)) == 480  # without replacement
    assert (problem.reference(4, 5) != drawn[:5]).any()
    with pytest.raises(ValueError, match="at most the 480 stored reference draws of toy, got 481"):
        problem.reference(0, 481)
    reference.save(folder)  # replaces the folder
    assert len(list(tmp_path.iterdir())) == 1
    with pytest.raises(ValueError, match="certificate must have toy's fingerprint"):
        replace(toy(freedom=4.0), stored=reference)


def test_failed_write_keeps_the_old_reference(tmp_path, certified, monkeypatch):
    certified.save(tmp_path / "toy")
    before = (tmp_path / "toy/certificate.json").read_text()
    monkeypatch.setattr(stored_references.np, "savez_compressed", disk_full)
    with pytest.raises(OSError, match=r"cannot write .*toy: No space left on device"):
        certified.save(tmp_path / "toy")
    assert (tmp_path / "toy/certificate.json").read_text() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("certificate.json", b"{", "must contain draws.npz"),
        ("certificate.json", b"{}", "certificate must have problem, draws"),
        ("draws.npz", b"PK", "must contain draws.npz"),
    ],
)
def test_damaged_references_are_rejected(tmp_path, certified, name, content, sentence):
    folder = certified.save(tmp_path / "toy")
    (folder / name).write_bytes(content)
    with pytest.raises(ValueError, match=sentence):
        StoredReference.load(folder)


def cached(problem, folder, draws=480, seed=1):
    return make_reference(problem, draws=draws, seed=seed, progress=False, unfinished=folder)


@pytest.fixture
def runs_made(monkeypatch):
    """Record the indices of the runs made during a test."""
    run, indices = making._run, []
    monkeypatch.setattr(making, "_MIN_RUN_DRAWS", 480)
    monkeypatch.setattr(making, "_run", lambda *args: indices.append(args[4]) or run(*args))
    return indices


def test_finished_runs_are_reused_for_equal_arguments_only(tmp_path, exact, runs_made, monkeypatch):
    expected = cached(exact, None)
    for indices in ([0, 1], []):
        runs_made.clear()
        reference = cached(exact, tmp_path)
        assert runs_made == indices
        assert np.array_equal(reference.positions, expected.positions)
        assert reference.certificate["fingerprint"] == expected.certificate["fingerprint"]
    likelihood = exact.posterior.likelihood
    # Mirrored observations have the same density at the origin.
    mirrored = replace(likelihood, joints=-likelihood.joints)
    other = replace(exact.posterior, likelihood=mirrored)
    for problem, options in (
        (exact, {"seed": 2}),
        (exact, {"draws": 4800}),
        (replace(exact, posterior=other, truth=None), {}),
        (replace(exact, name="another toy"), {}),
    ):
        runs_made.clear()
        cached(problem, tmp_path, **options)
        assert runs_made == [0, 1]
    runs_made.clear()
    monkeypatch.setattr(making, "library_versions", lambda: {"numpy": "1"})
    cached(exact, tmp_path)
    assert runs_made == [0, 1]


def test_file_errors_after_the_start_only_warn(tmp_path, exact, runs_made, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="writable"):
        cached(exact, tmp_path / "file" / "runs")
    assert not runs_made
    folder = tmp_path / "runs"
    expected = cached(exact, folder)
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    with pytest.warns(UserWarning, match="the run is repeated"):
        references = [cached(exact, folder)]
    assert runs_made == [0, 1, 0, 1]
    monkeypatch.setattr(MotionDraws, "save", disk_full)
    with pytest.warns(UserWarning, match="cannot store the run in .*: No space left on device"):
        references.append(cached(exact, tmp_path / "other"))
    for reference in references:
        assert np.array_equal(reference.positions, expected.positions)


class LatentPrior(StandardNormalPrior):
    """Prior of two frames of one joint at ``size`` θ, with a density of θ only."""

    skeleton, frames, fps, dim = Skeleton(["hip"], [-1]), 2, 30.0, 3

    def __init__(self, size=1.0):
        self.size = size

    def motion(self, theta):
        return self.size * theta[..., None, None, :] * np.ones((2, 1, 1))


def observed(size=1.0, location=0.5):
    """Return a problem with both frames observed at ``location`` · (1, −1, 2), noise .5."""
    joints = np.broadcast_to(location * np.array([1.0, -1.0, 2.0]), (2, 1, 3))
    return Problem("moved", "", MotionPosterior(LatentPrior(size), Joints3D(joints, noise=0.5)))


def test_random_walk_reference_of_a_latent_prior_is_correct():
    problem = observed()
    walk = load_sampler("mh")(warmup=1000, thin=10)
    reference = make_reference(problem, draws=4000, seed=1, progress=False, sampler=walk)
    # The posterior has precision 1 + 2 / .5² and mean 2 y / .5² over the precision.
    x = reference.positions[:, 0, 0]
    np.testing.assert_allclose(x.mean(axis=0), 0.5 * np.array([1, -1, 2]) * 8 / 9, atol=0.03)
    np.testing.assert_allclose(x.std(axis=0), 1 / 3, rtol=0.06)
    certificate = reference.certificate
    assert (certificate["exact"], certificate["seeds"]) == (False, None)
    assert certificate["rhat"] <= 1.01
    assert replace(problem, stored=reference).has_reference
    for other in (observed(size=1.1), observed(location=0.6)):
        with pytest.raises(ValueError, match="certificate must have moved's fingerprint"):
            replace(other, stored=reference)


def test_prior_draws_are_the_reference_without_observations():
    problem = Problem("moved", "", MotionPosterior(LatentPrior(2.0)))
    assert problem.has_reference
    assert problem.exact is None
    drawn = problem.reference(0, 4000)
    np.testing.assert_allclose(drawn.std(axis=0), 2, rtol=0.06)
    certificate = make_reference(problem, draws=800, progress=False).certificate
    assert [certificate[name] for name in ("sampler", "exact", "seeds")] == ["exact", True, None]


def test_truncation_changes_the_fingerprint():
    def fingerprint(limit):
        likelihood = observed(0.1, location=0.0).posterior.likelihood
        posterior = TruncatedPosterior(LatentPrior(0.1), likelihood, limit=limit)
        return stored_references.fingerprint_of(posterior, np.zeros((1, 2, 1, 3)))

    assert fingerprint(1e9) != fingerprint(2e9)
    assert len(fingerprint(1e9)) == len(fingerprint(np.inf)) + 2
    with pytest.raises(ValueError, match="posterior must have finite log densities"):
        fingerprint(1.001)


@pytest.mark.parametrize(
    "name",
    ["dance-pairs", "gait-noisy3d", "walk-vae-monocular", "salsa-pairs", "salsa-physical"],
)
def test_shipped_references_are_valid(name, request, monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    if name.startswith("salsa-"):
        real_data = request.getfixturevalue("real_data")
        (tmp_path / "cmu_salsa_pairs").symlink_to(real_data / "cmu_salsa_pairs")
    certificate = load_problem(name).stored.certificate
    assert certificate["rhat"] <= 1.01
    assert_agreed(certificate["agreement"])
    if certificate.get("agreement_wherever_they_stand") is not None:
        assert_agreed(certificate["agreement_wherever_they_stand"])


def test_shipped_reference_agrees_with_another_run(monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    problem = load_problem("gait-noisy3d")
    run = OutlierGibbs(thin=1).sample(problem.posterior, draws=60, chains=2, seed=9, progress=False)
    drawn, stored = run.flat(), problem.stored.positions
    difference = (drawn.mean(axis=0) - stored.mean(axis=0)) / stored.std(axis=0)
    assert np.sqrt((difference**2).mean()) < 2 / np.sqrt(60)
    assert np.abs(drawn.std(axis=0) / stored.std(axis=0) - 1).mean() < 2 / np.sqrt(2 * 60)


def test_unsuitable_problems_are_rejected(exact):
    with pytest.raises(ValueError, match="draws must be a multiple of 8, got 100"):
        make_reference(exact, draws=100)
    with pytest.raises(ValueError, match=r"prior must have log_prior\(positions\) or"):
        make_reference(load_problem("walk2d"))
    with pytest.raises(ValueError, match="posterior must have an exact prior and Joints3D with"):
        OutlierGibbs().sample(exact.posterior, draws=2)

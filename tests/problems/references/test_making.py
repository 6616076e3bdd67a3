"""Certified references: correct for known posteriors, refused for wrong runs, resumable."""

from __future__ import annotations

import json
from dataclasses import replace

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
from probmotion.problems.references import making as references
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


def runs_of(positions, problem, wrong=1.0):
    """Return two runs of four chains, the second with ``wrong`` times the spread."""
    mean = positions.mean(axis=0)
    runs = []
    for half, factor in zip(np.split(positions, 2), (1.0, wrong), strict=True):
        shaped = (mean + factor * (half - mean)).reshape(4, -1, *half.shape[1:])
        sampler = OutlierGibbs()
        runs.append(MotionDraws.of(problem.posterior, sampler, shaped, seed=0, seconds=0.0))
    return runs


@pytest.fixture(scope="module")
def exact():
    return toy()


@pytest.fixture(scope="module")
def heavy():
    return toy(freedom=3.0)


@pytest.fixture(scope="module")
def certified(exact):
    return make_reference(exact, draws=800, seed=2, progress=False)


@pytest.fixture(scope="module")
def made(heavy):
    gibbs = OutlierGibbs(thin=1)
    return make_reference(heavy, draws=480, seed=1, progress=False, sampler=gibbs)


def test_exact_problem_gets_an_exact_certificate(certified):
    certificate = certified.certificate
    assert certificate["exact"]
    assert [certificate[name] for name in ("sampler", "rhat", "draws")] == ["exact", None, 800]
    json.dumps(certificate, allow_nan=False)


@pytest.mark.parametrize("wrong", [0.9, 1.1])
def test_runs_of_different_spread_are_refused(exact, wrong):
    drawn = exact.reference(0, 4000)
    certify(exact, runs_of(drawn, exact), 0)
    with pytest.raises(ReferenceRefused, match="swd_ratio of two runs on toy must be at most"):
        certify(exact, runs_of(drawn, exact, wrong), 0)


def test_runs_whose_means_differ_are_refused(exact):
    drawn = exact.reference(0, 2000)
    moved = drawn + 0.15 * drawn.std(axis=0) * np.repeat([0, 1], 1000)[:, None, None, None]
    with pytest.raises(ReferenceRefused, match="of two runs on toy must be at most"):
        certify(exact, runs_of(moved, exact), 0)


def test_unmixed_chains_are_refused(exact):
    drawn = exact.reference(0, 2000)
    stuck = drawn + np.repeat([0.0, 0.3, 0.0, 0.3] * 2, 250)[:, None, None, None]
    with pytest.raises(ReferenceRefused, match=r"R-hat .* got 1"):
        certify(exact, runs_of(stuck, exact), 0)


@pytest.mark.parametrize("stuck", [0.0, 0.5])
def test_unmixed_poses_are_detected_after_alignment(exact, stuck):
    """Two chains of each run have longer bones, hidden by translations of metres."""
    rng = np.random.default_rng(0)
    shapes = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1.2, 1, 0]]]) * np.ones((4000, 1, 1, 1))
    longer = np.repeat([0.0, stuck, 0.0, stuck] * 2, 500)[:, None] + 0.1 * rng.normal(
        size=(4000, 1)
    )
    shapes[:, :, 1, 0] += longer
    anywhere = shapes + 10 * rng.normal(size=(4000, 1, 1, 3))
    if stuck:
        with pytest.raises(ReferenceRefused, match=r"R-hat .* got 1"):
            certify(exact, runs_of(anywhere, exact), 0)
    else:
        kept = certify(exact, runs_of(anywhere, exact), 0)
        apart = kept.certificate["agreement_wherever_they_stand"]
        assert apart["swd_ratio"] <= apart["swd_ratio_at_most"]


@pytest.mark.parametrize(
    ("apart", "why"), [(0.0, "more than one motion"), (0.5, "of two runs on toy")]
)
def test_constant_poses_are_refused_after_alignment(exact, apart, why):
    """One shape, the same or different between runs."""
    rng = np.random.default_rng(0)
    shapes = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1.2, 1, 0]]]) * np.ones((4000, 1, 1, 1))
    shapes[2000:, :, 1, 0] += apart
    anywhere = shapes + 10 * rng.normal(size=(4000, 1, 1, 3))
    with pytest.raises(ReferenceRefused, match=why):
        certify(exact, runs_of(anywhere, exact), 0)


def test_equal_distributions_agree():
    """Both limits hold for 20 pairs of equal distributions."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        pair = rng.normal(size=(2, 4, 50, 2, 2, 3)) * np.linspace(0.1, 3, 12).reshape(2, 2, 3)
        found = agreement(*pair, seed=0)
        assert found["swd_ratio"] <= found["swd_ratio_at_most"]
        assert found["mean_z"] <= found["mean_z_at_most"]


def test_gibbs_matches_importance_sampling(heavy):
    """Importance weights relative to the exact posterior with Gaussian noise."""
    problem, posterior = heavy, heavy.posterior
    run = OutlierGibbs(thin=1).sample(posterior, draws=1000, chains=2, seed=1, progress=False)
    wide = replace(posterior.likelihood, degrees_of_freedom=None, noise=0.5)
    proposal = posterior.prior.exact_posterior(wide)
    some = proposal.sample(np.random.default_rng(0), 20_000)
    log_weight = problem.log_density_of(some) - proposal.log_density(some)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    drawn = run.flat()
    for power in (1, 2):
        wanted = np.einsum("n,nljx->ljx", weight, some**power)
        spread = (drawn**power).std(axis=0)
        error = spread * np.sqrt(1 / 1000 + (weight**2).sum())
        assert (np.abs((drawn**power).mean(axis=0) - wanted) < 5 * error).all()


def test_saved_reference_is_loaded_and_sampled(tmp_path, heavy, made):
    problem = heavy
    assert (made.n, made.certificate["draws_made"]) == (480, 4000)
    folder = made.save(tmp_path / "toy")
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "certificate.json", "draws.npz", "toy",
    ]  # fmt: skip
    kept = replace(problem, stored=StoredReference.load(folder))
    assert kept.has_reference
    assert not problem.has_reference
    assert (kept.max_references, problem.max_references) == (480, None)
    drawn = kept.reference(3, 480)
    np.testing.assert_array_equal(drawn, kept.reference(3, 480))
    assert len(np.unique(drawn.reshape(480, -1), axis=0)) == 480  # without replacement
    assert (kept.reference(4, 5) != drawn[:5]).any()
    with pytest.raises(
        ValueError, match="n must be at most the 480 stored reference draws of toy, got 481"
    ):
        kept.reference(0, 481)
    # Saving replaces the folder.
    made.save(folder)
    assert len(list(tmp_path.iterdir())) == 1


def test_reference_of_another_posterior_is_rejected(made):
    other = toy(freedom=4.0)
    with pytest.raises(ValueError, match="certificate must have toy's fingerprint"):
        replace(other, stored=made)


def test_failed_write_keeps_the_old_reference(tmp_path, certified, monkeypatch):
    certified.save(tmp_path / "toy")
    before = (tmp_path / "toy/certificate.json").read_text()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(stored_references.np, "savez_compressed", full)
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
def halves(monkeypatch):
    """Record the indices of the runs made during a test."""
    run, made = references._run, []
    monkeypatch.setattr(references, "_LEAST", 480)
    monkeypatch.setattr(references, "_run", lambda *given: made.append(given[4]) or run(*given))
    return made


def test_finished_run_is_reused(tmp_path, exact, halves, monkeypatch):
    save = MotionDraws.save

    def interrupted(run, path):
        save(run, path)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MotionDraws, "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            cached(exact, tmp_path)
    reference = cached(exact, tmp_path)
    assert halves == [0, 1]
    uncached = cached(exact, None)
    assert np.array_equal(reference.positions, uncached.positions)
    assert reference.certificate["fingerprint"] == uncached.certificate["fingerprint"]


def test_cache_key_distinguishes_runs(tmp_path, exact, halves, monkeypatch):
    cached(exact, tmp_path)
    seen = exact.posterior.likelihood
    # Mirrored observations have the same density at the origin.
    other = replace(exact.posterior, likelihood=replace(seen, joints=-seen.joints))
    for problem, options in (
        (exact, {"seed": 2}),
        (exact, {"draws": 4800}),
        (replace(exact, posterior=other, truth=None), {}),
        (replace(exact, name="another toy"), {}),
    ):
        halves.clear()
        cached(problem, tmp_path, **options)
        assert halves == [0, 1]
    halves.clear()
    monkeypatch.setattr(references, "library_versions", lambda: {"numpy": "1"})
    cached(exact, tmp_path)
    assert halves == [0, 1]


def test_file_errors_only_warn(tmp_path, exact, halves, monkeypatch):
    expected = cached(exact, tmp_path)
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    halves.clear()
    with pytest.warns(UserWarning, match="the run is repeated"):
        reference = cached(exact, tmp_path)
    assert halves == [0, 1]
    assert np.array_equal(reference.positions, expected.positions)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(MotionDraws, "save", full)
    with pytest.warns(UserWarning, match="cannot store the run in .*: No space left on device"):
        reference = cached(exact, tmp_path / "other")
    assert np.array_equal(reference.positions, expected.positions)


def test_unwritable_folder_fails_before_the_first_run(tmp_path, exact, halves):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="writable"):
        cached(exact, tmp_path / "file" / "runs")
    assert not halves


class Moved(StandardNormalPrior):
    """Prior of two frames of one joint at ``size`` θ, with a density of θ only."""

    skeleton, frames, fps, dim = Skeleton(["hip"], [-1]), 2, 30.0, 3

    def __init__(self, size=1.0):
        self.size = size

    def motion(self, theta):
        return self.size * theta[..., None, None, :] * np.ones((2, 1, 1))


def seen(size=1.0, at=0.5):
    """Return both frames observed at ``at`` times (1, −1, 2) with noise .5."""
    shown = np.broadcast_to(at * np.array([1.0, -1.0, 2.0]), (2, 1, 3))
    return Problem("moved", "", MotionPosterior(Moved(size), Joints3D(shown, noise=0.5)))


def test_random_walk_reference_of_a_latent_prior_is_correct():
    problem = seen()
    walk = load_sampler("mh")(warmup=1000, thin=10)
    kept = make_reference(problem, draws=4000, seed=1, progress=False, sampler=walk)
    # Precision 1 + 2 / .5² and mean 2 y / .5² over the precision.
    x = kept.positions[:, 0, 0]
    np.testing.assert_allclose(x.mean(axis=0), 0.5 * np.array([1, -1, 2]) * 8 / 9, atol=0.03)
    np.testing.assert_allclose(x.std(axis=0), 1 / 3, rtol=0.06)
    assert not kept.certificate["exact"]
    assert kept.certificate["rhat"] <= 1.01
    assert kept.certificate["seeds"] is None

    class Seeded(Moved):
        def seed_coordinates(self):
            return np.zeros((1, 3))

    assert references._n_seeds(replace(problem, posterior=MotionPosterior(Seeded()))) == 1
    assert replace(problem, stored=kept).has_reference
    for other in (seen(size=1.1), seen(at=0.6)):
        with pytest.raises(ValueError, match="certificate must have moved's fingerprint"):
            replace(other, stored=kept)


def test_prior_draws_are_the_reference_without_observations():
    problem = Problem("moved", "", MotionPosterior(Moved(2.0)))
    assert problem.has_reference
    assert problem.exact is None
    drawn = problem.reference(0, 4000)
    np.testing.assert_allclose(drawn.std(axis=0), 2, rtol=0.06)
    kept = make_reference(problem, draws=800, progress=False)
    assert (kept.certificate["sampler"], kept.certificate["exact"]) == ("exact", True)
    assert kept.certificate["seeds"] is None


def test_truncation_changes_the_fingerprint():
    def known(limit):
        cut = TruncatedPosterior(Moved(0.1), seen(0.1, at=0.0).posterior.likelihood, limit=limit)
        return stored_references.fingerprint_of(cut, np.zeros((1, 2, 1, 3)))

    assert known(1e9) != known(2e9)
    assert len(known(1e9)) == len(known(np.inf)) + 2
    with pytest.raises(ValueError, match="posterior must have finite log densities"):
        known(1.001)


@pytest.mark.parametrize("name", ["dance-pairs", "gait-noisy3d", "walk-vae-monocular"])
def test_shipped_references_are_valid(name, monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    check_shipped(name)


def test_shipped_reference_of_real_pairs_is_valid(real_data, monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    (tmp_path / "cmu_salsa_pairs").symlink_to(real_data / "cmu_salsa_pairs")
    check_shipped("salsa-pairs")


def check_shipped(name):
    problem = load_problem(name)
    assert problem.has_reference
    certificate = problem.stored.certificate
    assert certificate["rhat"] <= 1.01
    for agreed in (certificate["agreement"], certificate.get("agreement_wherever_they_stand")):
        if agreed is not None:
            assert agreed["swd_ratio"] <= agreed["swd_ratio_at_most"]
            assert agreed["mean_z"] <= agreed["mean_z_at_most"]


def test_shipped_reference_agrees_with_another_run(monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    problem = load_problem("gait-noisy3d")
    run = OutlierGibbs(thin=1).sample(problem.posterior, draws=60, chains=2, seed=9, progress=False)
    drawn, kept = run.flat(), problem.reference(0, problem.max_references)
    apart = np.abs(drawn.mean(axis=0) - kept.mean(axis=0)) / kept.std(axis=0)
    assert np.sqrt((apart**2).mean()) < 2 / np.sqrt(60)
    assert np.abs(drawn.std(axis=0) / kept.std(axis=0) - 1).mean() < 2 / np.sqrt(2 * 60)


def test_unsuitable_problems_are_rejected(exact):
    with pytest.raises(ValueError, match="draws must be a multiple of 8, got 100"):
        make_reference(exact, draws=100)
    with pytest.raises(ValueError, match=r"prior must have log_prior\(positions\) or"):
        make_reference(load_problem("walk2d"))
    with pytest.raises(ValueError, match="posterior must have an exact prior and Joints3D with"):
        OutlierGibbs().sample(exact.posterior, draws=2)

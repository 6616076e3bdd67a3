"""Reference draws of long runs: right where the answer is known, refused where they are wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from probmotion import Joints3D, Motion, MotionDraws, MotionPosterior, seeds
from probmotion.models import GaussianMixtureMotion
from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.reference import StoredReference
from probmotion.posteriors.sampling import load_sampler
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem
from probmotion.problems.references import making as references, store as kept_references
from probmotion.problems.references.making import (
    ReferenceRefused,
    agreement,
    certify,
    make_reference,
)
from probmotion.problems.references.outlier_gibbs import OutlierGibbs, _Weighted


def toy(
    freedom: float | None = None,
    styles: int = 2,
    azimuths: int = 4,
    coordinates: Literal["latent", "positions"] = "positions",
) -> Problem:
    """Two frames of a bone that sways, seen as noisy joints."""
    rng = np.random.default_rng(0)
    prior = GaussianMixtureMotion(
        Skeleton(["hip", "knee"], [-1, 0]),
        30.0,
        means=rng.normal(size=(styles, 2, 2, 3)),
        factors=0.4 * rng.normal(size=(styles, 2, 2, 2, 3)),
        weights=np.full(styles, 1 / styles),
        noise=0.2,
        azimuths=azimuths,
        coordinates=coordinates,
    )
    truth = prior.sample(rng, 1)[0]
    evidence = Joints3D.observe(
        Motion(truth, prior.skeleton, 30.0), 0.3, 1, degrees_of_freedom=freedom
    )
    return Problem("toy", "", MotionPosterior(prior, evidence), truth)


def runs_of(positions: np.ndarray, problem: Problem, wrong: float = 1.0) -> list[MotionDraws]:
    """Two runs of four chains; the second one's draws are spread ``wrong`` times as far."""
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
def made(heavy):
    gibbs = OutlierGibbs(thin=1)
    return make_reference(heavy, draws=480, seed=1, progress=False, sampler=gibbs)


def test_nuts_on_a_conjugate_posterior_agrees_with_exact_draws():
    exact = toy(styles=1, azimuths=1, coordinates="latent")
    prior = exact.posterior.prior
    nuts = load_sampler("nuts")(warmup=200, candidates=1)
    runs = [
        nuts.sample(exact.posterior, draws=500, chains=4, seed=seed, progress=False)
        for seed in (1, 2)
    ]
    kept = certify(exact, runs, 0)
    assert kept.certificate["rhat"] <= 1.01
    assert kept.certificate["ess_bulk"] > 400
    drawn = prior.exact_posterior(exact.posterior.likelihood).sample(seeds.generator(5), 4000)
    found = agreement(
        kept.positions.reshape(4, 1000, 2, 2, 3), drawn.reshape(4, 1000, 2, 2, 3), seed=0
    )
    assert found["swd_ratio"] <= found["swd_ratio_at_most"]
    assert found["mean_z"] <= found["mean_z_at_most"]


def test_draws_of_exact_sets_agree_and_say_so(exact):
    kept = make_reference(exact, draws=800, seed=2, progress=False)
    told = kept.certificate
    assert told["exact"]
    assert (told["sampler"], told["rhat"], told["draws"]) == ("exact", None, 800)
    json.dumps(told, allow_nan=False)


@pytest.mark.parametrize("wrong", [0.9, 1.1])
def test_a_run_that_is_too_narrow_or_too_wide_is_refused(exact, wrong):
    drawn = exact.reference(0, 4000)
    certify(exact, runs_of(drawn, exact), 0)
    with pytest.raises(ReferenceRefused, match="runs on toy disagree, swd_ratio is"):
        certify(exact, runs_of(drawn, exact, wrong), 0)


def test_runs_whose_means_differ_are_refused(exact):
    drawn = exact.reference(0, 2000)
    moved = drawn + 0.15 * drawn.std(axis=0) * np.repeat([0, 1], 1000)[:, None, None, None]
    with pytest.raises(ReferenceRefused, match="disagree"):
        certify(exact, runs_of(moved, exact), 0)


def test_chains_that_have_not_mixed_are_refused(exact):
    drawn = exact.reference(0, 2000)
    stuck = drawn + np.repeat([0.0, 0.3, 0.0, 0.3] * 2, 250)[:, None, None, None]
    with pytest.raises(ReferenceRefused, match="R-hat of 1"):
        certify(exact, runs_of(stuck, exact), 0)


@pytest.mark.parametrize("stuck", [0.0, 0.5])
def test_poses_that_have_not_mixed_do_not_hide_behind_where_they_stand(exact, stuck):
    """Two chains of each run have longer bones; every draw stands somewhere, metres apart."""
    rng = np.random.default_rng(0)
    shapes = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1.2, 1, 0]]]) * np.ones((4000, 1, 1, 1))
    longer = np.repeat([0.0, stuck, 0.0, stuck] * 2, 500)[:, None] + 0.1 * rng.normal(
        size=(4000, 1)
    )
    shapes[:, :, 1, 0] += longer
    anywhere = shapes + 10 * rng.normal(size=(4000, 1, 1, 3))
    if stuck:
        with pytest.raises(ReferenceRefused, match="R-hat of 1"):
            certify(exact, runs_of(anywhere, exact), 0)
    else:
        kept = certify(exact, runs_of(anywhere, exact), 0)
        apart = kept.certificate["agreement_wherever_they_stand"]
        assert apart["swd_ratio"] <= apart["swd_ratio_at_most"]


@pytest.mark.parametrize(("apart", "why"), [(0.0, "hold one motion wherever"), (0.5, "disagree")])
def test_a_pose_that_never_moves_is_refused_wherever_it_stands(exact, apart, why):
    """One shape all along, the same in both runs or each its own."""
    rng = np.random.default_rng(0)
    shapes = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1.2, 1, 0]]]) * np.ones((4000, 1, 1, 1))
    shapes[2000:, :, 1, 0] += apart
    anywhere = shapes + 10 * rng.normal(size=(4000, 1, 1, 3))
    with pytest.raises(ReferenceRefused, match=why):
        certify(exact, runs_of(anywhere, exact), 0)


def test_agreeing_runs_are_seldom_refused():
    """Both bounds hold for 20 pairs of sets that are alike."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        pair = rng.normal(size=(2, 4, 50, 2, 2, 3)) * np.linspace(0.1, 3, 12).reshape(2, 2, 3)
        found = agreement(*pair, seed=0)
        assert found["swd_ratio"] <= found["swd_ratio_at_most"]
        assert found["mean_z"] <= found["mean_z_at_most"]


def test_gibbs_draws_what_the_density_says(heavy):
    """Importance weights from the exact posterior of Gaussian noise: another way to each mean."""
    problem, posterior = heavy, heavy.posterior
    run = OutlierGibbs(thin=2).sample(posterior, draws=1000, chains=2, seed=1, progress=False)
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


def test_evidence_of_given_precisions_is_drawn_with_them():
    """Residuals times √precision are N(0, 1), the density falls by half their square."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(200, 30, 3))
    precision = rng.gamma(2.0, 50.0, truth.shape)
    precision[:, 0] = 0
    blank = _Weighted(Joints3D(np.full_like(truth, 7.0), 0.1), precision)
    drawn = blank.simulate(rng, truth)
    seen = ((drawn.evidence.joints - truth) * np.sqrt(precision))[:, 1:]
    assert (drawn.evidence.joints[:, 0] == 7.0).all()
    assert abs(seen.mean()) < 5 / np.sqrt(seen.size)
    assert abs(seen.var() - 1) < 5 * np.sqrt(2 / seen.size)
    fall = drawn.log_density(drawn.evidence.joints) - drawn.log_density(truth)
    assert fall == pytest.approx(0.5 * (seen**2).sum())


def test_gibbs_draws_from_nothing_else(exact):
    with pytest.raises(ValueError, match="posterior has Joints3D evidence, expected Joints3D with"):
        OutlierGibbs().sample(exact.posterior, draws=2)


def test_what_was_saved_is_read_and_served(tmp_path, heavy, made):
    problem = heavy
    assert (made.n, made.certificate["draws_made"]) == (480, 4000)
    folder = made.save(tmp_path / "toy")
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "certificate.json", "draws.npz", "toy",
    ]  # fmt: skip
    kept = replace(problem, kept=StoredReference.load(folder))
    assert kept.has_reference
    assert not problem.has_reference
    assert (kept.most_reference, problem.most_reference) == (480, None)
    drawn = kept.reference(3, 480)
    np.testing.assert_array_equal(drawn, kept.reference(3, 480))
    assert len(np.unique(drawn.reshape(480, -1), axis=0)) == 480  # without replacement
    assert (kept.reference(4, 5) != drawn[:5]).any()
    with pytest.raises(ValueError, match="n must be at most the 480 reference draws, got 481"):
        kept.reference(0, 481)
    # What is there is replaced whole.
    made.save(folder)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_reference_of_another_posterior_is_refused(made):
    other = toy(freedom=4.0)
    with pytest.raises(ValueError, match="certificate is of another posterior than toy's"):
        replace(other, kept=made)


def test_a_disk_that_fails_leaves_what_was_there(tmp_path, exact, monkeypatch):
    made = make_reference(exact, draws=80, progress=False)
    made.save(tmp_path / "toy")
    before = (tmp_path / "toy/certificate.json").read_text()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept_references.np, "savez_compressed", full)
    with pytest.raises(OSError, match=r"cannot write .*toy: No space left on device"):
        made.save(tmp_path / "toy")
    assert (tmp_path / "toy/certificate.json").read_text() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("certificate.json", b"{", "holds no reference"),
        ("certificate.json", b"{}", "certificate lacks problem, draws"),
        ("draws.npz", b"PK", "holds no reference"),
    ],
)
def test_broken_files_are_told(tmp_path, exact, name, content, sentence):
    folder = make_reference(exact, draws=80, progress=False).save(tmp_path / "toy")
    (folder / name).write_bytes(content)
    with pytest.raises(ValueError, match=sentence):
        StoredReference.load(folder)


def kept_by(problem, folder, draws=480, seed=1, thin=1):
    """As ``made``, with a folder for runs that have ended."""
    gibbs = OutlierGibbs(thin=thin)
    return make_reference(
        problem, draws=draws, seed=seed, progress=False, sampler=gibbs, unfinished=folder
    )


@pytest.fixture
def halves(monkeypatch):
    """The halves whose runs are made from now on."""
    run, found = references._run, []
    monkeypatch.setattr(references, "_run", lambda *asked: found.append(asked[4]) or run(*asked))
    return found


def test_a_run_that_has_ended_is_not_made_again(tmp_path, heavy, made, halves, monkeypatch):
    save = MotionDraws.save

    def stopped(run, path):
        save(run, path)
        raise KeyboardInterrupt

    with monkeypatch.context() as stopping:
        stopping.setattr(MotionDraws, "save", stopped)
        with pytest.raises(KeyboardInterrupt):
            kept_by(heavy, tmp_path)
    kept = kept_by(heavy, tmp_path)
    assert halves == [0, 1]
    assert np.array_equal(kept.positions, made.positions)
    assert kept.certificate == made.certificate


@pytest.mark.slow
def test_runs_of_anything_else_are_made(tmp_path, heavy, halves, monkeypatch):
    """Other evidence has the same density where all joints are at the origin."""
    kept_by(heavy, tmp_path)
    seen = heavy.posterior.likelihood
    other = replace(heavy.posterior, likelihood=replace(seen, joints=-seen.joints))
    named = replace(heavy, name="another toy")
    for problem, how in (
        (heavy, {"seed": 2}),
        (heavy, {"thin": 2}),
        (heavy, {"draws": 4800}),
        (replace(heavy, posterior=other, truth=None), {}),
        (named, {}),
    ):
        halves.clear()
        kept_by(problem, tmp_path, **how)
        assert halves == [0, 1]
    halves.clear()
    monkeypatch.setattr(references, "library_versions", lambda: {"numpy": "1"})
    kept_by(heavy, tmp_path)
    assert halves == [0, 1]


def test_a_file_that_fails_stops_no_run(tmp_path, heavy, made, halves, monkeypatch):
    kept_by(heavy, tmp_path)
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:100])
    halves.clear()
    with pytest.warns(UserWarning, match="no netCDF file.*; the run is made anew"):
        kept = kept_by(heavy, tmp_path)
    assert halves == [0, 1]
    assert np.array_equal(kept.positions, made.positions)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(MotionDraws, "save", full)
    with pytest.warns(UserWarning, match="cannot keep the run in .*: No space left on device"):
        kept = kept_by(heavy, tmp_path / "other")
    assert np.array_equal(kept.positions, made.positions)


def test_a_folder_that_cannot_be_written_to_is_told_before_the_first_run(tmp_path, heavy, halves):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="expected a writable folder"):
        kept_by(heavy, tmp_path / "file" / "runs")
    assert not halves


def test_a_number_of_draws_that_chains_cannot_share_is_refused(exact):
    with pytest.raises(ValueError, match="draws must be a multiple of 8, got 100"):
        make_reference(exact, draws=100)


class Moved(StandardNormalPrior):
    """Two frames of one joint, which stands at ``size`` θ: only θ has a density."""

    skeleton, frames, fps, dim = Skeleton(["hip"], [-1]), 2, 30.0, 3

    def __init__(self, size: float = 1.0) -> None:
        self.size = size

    def motion(self, theta):
        return self.size * theta[..., None, None, :] * np.ones((2, 1, 1))


def seen(size: float = 1.0, at: float = 0.5) -> Problem:
    """Both frames were seen ``at`` 1, −1 and 2 times, with noise of .5: Gaussian, by hand."""
    shown = np.broadcast_to(at * np.array([1.0, -1.0, 2.0]), (2, 1, 3))
    return Problem("moved", "", MotionPosterior(Moved(size), Joints3D(shown, noise=0.5)))


def test_of_a_prior_without_density_of_positions_a_long_run_is_right_and_known_again():
    problem = seen()
    walk = load_sampler("mh")(warmup=2000, thin=20)
    kept = make_reference(problem, draws=4000, seed=1, progress=False, sampler=walk)
    # Of precision 1 + 2 / .5², at 2 y / .5² over it.
    x = kept.positions[:, 0, 0]
    np.testing.assert_allclose(x.mean(axis=0), 0.5 * np.array([1, -1, 2]) * 8 / 9, atol=0.03)
    np.testing.assert_allclose(x.std(axis=0), 1 / 3, rtol=0.06)
    assert not kept.certificate["exact"]
    assert kept.certificate["rhat"] <= 1.01
    assert replace(problem, kept=kept).has_reference
    for other in (seen(size=1.1), seen(at=0.6)):
        with pytest.raises(ValueError, match="certificate is of another posterior than moved's"):
            replace(other, kept=kept)


def test_without_evidence_the_priors_own_draws_are_the_reference():
    problem = Problem("moved", "", MotionPosterior(Moved(2.0)))
    assert problem.has_reference
    assert problem.exact is None
    drawn = problem.reference(0, 4000)
    np.testing.assert_allclose(drawn.std(axis=0), 2, rtol=0.06)
    kept = make_reference(problem, draws=800, progress=False)
    assert (kept.certificate["sampler"], kept.certificate["exact"]) == ("exact", True)
    assert kept.certificate["seeds"] is None


@pytest.mark.parametrize(
    ("drawn", "sentence"),
    [
        (np.zeros((5, 2, 3)), r"sample\(rng, 5\) of Odd has shape \(5, 2, 3\), expected"),
        (
            np.full((5, 2, 1, 3), np.nan),
            r"sample\(rng, 5\) of Odd must be finite, got 30 values that are NaN",
        ),
    ],
)
def test_draws_of_a_prior_that_are_no_motions_are_no_reference(drawn, sentence):
    class Odd(Moved):
        def sample(self, rng, n):
            return drawn

    with pytest.raises(ValueError, match=sentence):
        Problem("odd", "", MotionPosterior(Odd())).reference(0, 5)


def test_a_cut_density_is_another_posterior():
    def known(limit: float) -> list[float]:
        cut = TruncatedPosterior(Moved(0.1), seen(0.1, at=0.0).posterior.likelihood, limit=limit)
        return kept_references.fingerprint_of(cut, np.zeros((1, 2, 1, 3)))

    assert known(1e9) != known(2e9)
    assert len(known(1e9)) == len(known(np.inf)) + 2
    with pytest.raises(
        ValueError, match=r"posterior has log densities of .*-inf.* at draws of its"
    ):
        known(1.001)


def test_chains_that_start_at_one_seed_are_told():
    class Seeded(Moved):
        def seed_coordinates(self):
            return np.zeros((1, 3))

    evidence = seen().posterior.likelihood
    problem = Problem("seeded", "", MotionPosterior(Seeded(), evidence))
    walk = load_sampler("mh")(warmup=2000, thin=20)
    kept = make_reference(problem, draws=4000, seed=1, progress=False, sampler=walk)
    assert kept.certificate["seeds"] == 1


def test_a_prior_without_any_density_has_no_reference():
    with pytest.raises(ValueError, match="prior MotionDiffusion has no density, expected one of"):
        make_reference("walk2d")


@pytest.mark.parametrize("name", ["dance-pairs", "gait-noisy3d", "walk-vae-monocular"])
def test_shipped_references_are_of_their_problems(name, monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    check_shipped(name)


def test_the_reference_of_real_pairs_is_of_their_problem(real_data, monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    (tmp_path / "cmu_salsa_pairs").symlink_to(real_data / "cmu_salsa_pairs")
    check_shipped("salsa-pairs")


def check_shipped(name: str) -> None:
    problem = load_problem(name)
    assert problem.has_reference
    told = problem.kept.certificate
    assert told["rhat"] <= 1.01
    for agreed in (told["agreement"], told.get("agreement_wherever_they_stand")):
        if agreed is not None:
            assert agreed["swd_ratio"] <= agreed["swd_ratio_at_most"]
            assert agreed["mean_z"] <= agreed["mean_z_at_most"]


def test_the_shipped_reference_agrees_with_another_run(monkeypatch, tmp_path):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    problem = load_problem("gait-noisy3d")
    run = OutlierGibbs(thin=1).sample(problem.posterior, draws=60, chains=2, seed=9, progress=False)
    drawn, kept = run.flat(), problem.reference(0, problem.most_reference)
    apart = np.abs(drawn.mean(axis=0) - kept.mean(axis=0)) / kept.std(axis=0)
    assert np.sqrt((apart**2).mean()) < 2 / np.sqrt(60)
    assert np.abs(drawn.std(axis=0) / kept.std(axis=0) - 1).mean() < 2 / np.sqrt(2 * 60)

"""Modes and draws of reconstructions of made images."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("numba")
import torch
from scipy import ndimage

from probmotion.models.images.category import Category
from probmotion.models.images.encoder import Estimates
from probmotion.models.images.encoder_training import encoder_of
from probmotion.models.images.image_likelihood import ImageLikelihood
from probmotion.models.images.made_images import make_images
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.latent.turn_code import TurnCode
from probmotion.reconstruction import Reconstruction, inference, reconstruct, refinement
from probmotion.reconstruction.inference import (
    _UNCOVERED,
    _outline_error,
    _uncovered_radius,
    encoded,
)
from probmotion.reconstruction.refinement import Mode, promising, refine

SIZE, TANGENT = 64, np.array([0.15])


def observed(made, k: int) -> ImageObservation:
    return ImageObservation(made.mask[k][None], made.rgb[k][None], None, TANGENT, np.eye(3)[None])


@pytest.fixture(scope="module")
def animal():
    """The shipped quadruped and made images of it."""
    category = Category.load("quadruped")
    prior = SurfacePrior(category, TANGENT)
    return category, prior, make_images(prior, np.random.default_rng(3), 4, SIZE)


def test_refinement_finds_the_pose_again(animal) -> None:
    """From a start nearby, it reaches at least the density of the truth and is closer to it."""
    _, prior, images = animal
    observation, truth = observed(images, 1), images.theta[1]
    rng = np.random.default_rng(1)
    start = truth + 0.3 * rng.standard_normal(truth.shape)
    (mode,) = refine(prior, observation, start[None])
    density = prior.log_likelihood(truth[None], observation) + prior.log_density(truth)
    reached = prior.log_likelihood(mode.theta[None], observation)
    assert reached[0] + prior.log_density(mode.theta) >= density[0]

    def distance(theta: np.ndarray) -> float:
        joints = prior.motion(np.stack([theta, truth]))[:, 0]
        middle = joints.mean(axis=1, keepdims=True)
        return float(np.linalg.norm(np.diff(joints - middle, axis=0), axis=-1).mean())

    assert distance(mode.theta) < 0.7 * distance(start)
    # Draws keep the length of the two coordinates of the direction.
    radial = np.zeros(prior.dim)
    place = slice(prior.layout.view.start, prior.layout.view.start + 2)
    radial[place] = mode.theta[place] / np.linalg.norm(mode.theta[place])
    assert np.linalg.norm(mode.theta[place]) == pytest.approx(np.sqrt(2), rel=1e-5)
    assert radial @ np.linalg.solve(mode.precision, radial) < 0.02


def test_refinement_finds_the_direction_that_mirrors_the_start(animal, monkeypatch) -> None:
    """A silhouette from the side hardly shows whether a body faces towards the camera or away."""
    _, prior, images = animal
    truth = prior.facing(images.theta[:1], 2.0)  # away from the camera, to the right
    made = make_images(prior, np.random.default_rng(4), 1, SIZE, truth)
    observation = replace(observed(made, 0), rgb=None)
    start = prior.mirrored(made.theta)
    sine, cosine = prior.layout.view.start, prior.layout.view.start + 1
    assert start[0, sine] > 0
    assert start[0, cosine] > 0
    (alone,) = refine(prior, observation, start)
    assert alone.theta[cosine] > 0
    modes = refine(prior, observation, start, keep=2)
    assert modes[0].theta[sine] > 0
    assert modes[0].theta[cosine] < 0
    assert modes[0].log_density > alone.log_density
    # Skeletons without symmetry have no mirror images.
    monkeypatch.setitem(vars(prior.category.body), "symmetric", False)
    (unmirrored,) = refine(prior, observation, start, keep=2)
    np.testing.assert_array_equal(unmirrored.theta, alone.theta)


def test_two_equal_images_tell_as_much_as_one(animal, monkeypatch) -> None:
    """A body that stands still: the information of T images is that of one."""
    category, _, images = animal
    code = category.code
    still = TurnCode(code.mean[[0, 0]], code.basis[:, [0, 0]], code.fps)
    category = replace(category, code=still)
    monkeypatch.setattr(refinement, "_STAGES", ((32, 1.0, 0),))
    precisions = []
    for count in (1, 2):
        prior = SurfacePrior(category, np.repeat(TANGENT, count))
        theta = np.zeros((1, prior.dim))
        theta[:, : images.theta.shape[1]] = images.theta[0]
        one = observed(images, 0)
        repeated = (np.repeat(part, count, axis=0) for part in (one.mask, one.rgb))
        cameras = prior.tangent, np.tile(np.eye(3), (count, 1, 1))
        (mode,) = refine(prior, ImageObservation(*repeated, None, *cameras), theta)
        precisions.append(np.diag(mode.precision)[prior.layout.lengths] - 1)
    # One of the lengths hardly changes the image.
    np.testing.assert_allclose(precisions[1], precisions[0], rtol=1e-3, atol=1e-9)


def test_the_most_probable_candidates_come_first(animal) -> None:
    _, prior, images = animal
    others = prior.initial(np.random.default_rng(2), 60)
    candidates = np.concatenate([others[:30], images.theta[:1], others[30:]])
    best = promising(prior, observed(images, 0), candidates, 3)
    np.testing.assert_array_equal(best[0], images.theta[0])
    assert best.shape == (3, prior.dim)


def test_estimates_of_the_network_become_parameters(animal) -> None:
    _, prior, images = animal
    start, quarter = prior.layout.view.start, 1
    means = torch.linspace(-0.3, 0.6, prior.dim - 1).tile(1, 4, 1)
    weights = torch.tensor([[0.004, 0.99, 0.003, 0.003]]).log()
    estimates = Estimates(weights, means, torch.full_like(means, -5.0))
    rng = np.random.default_rng(0)
    found, drawn = encoded(lambda _: estimates, prior, observed(images, 0), rng, 300)
    values = means[0, quarter].numpy()
    assert found.shape == (1, prior.dim)
    assert drawn.shape == (300, prior.dim)
    same = np.abs(drawn - found).max(axis=1) < 0.1
    assert 0.97 < same.mean() < 1
    assert (drawn - found)[same][:, :start].std() == pytest.approx(np.exp(-5), rel=0.05)
    np.testing.assert_allclose(found[0, :start], values[1 : start + 1])
    np.testing.assert_allclose(found[0, start + 2 :], values[start + 1 :])
    yaw = np.arctan2(found[0, start], found[0, start + 1])
    assert yaw == pytest.approx(np.pi / 2 + values[0])


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_the_best_draws_of_likely_quarters_are_refined(animal, monkeypatch) -> None:
    _, prior, images = animal
    truth, start = images.theta[0], prior.layout.view.start
    yaw = np.arctan2(*truth[start : start + 2])
    likely = prior.facing(np.zeros((2, prior.dim)), yaw + np.array([0, np.pi]))
    drawn = np.concatenate([prior.initial(np.random.default_rng(1), 200), truth[None]])
    monkeypatch.setattr(inference, "refine", lambda prior, observed, starts, keep: starts)
    starts = inference.modes_of(prior, observed(images, 0), likely, drawn)
    np.testing.assert_array_equal(starts[:2], likely)
    assert truth.tolist() in starts.tolist()
    quarters = refinement.quarters_of(prior, starts)
    assert sorted(quarters[2:]) == sorted(np.repeat(quarters[:2], inference._STARTS // 2))


def test_reconstructions_use_one_thread(animal, monkeypatch, two_threads) -> None:
    """Modes, and the draws about them."""
    category, prior, images = animal
    monkeypatch.setattr(inference, "refine", lambda *args, keep: torch.get_num_threads())
    assert inference.posterior_modes(encoder_of(category), prior, observed(images, 0)) == 1
    threads = []

    def draws(modes, rng, n):
        threads.append(torch.get_num_threads())
        return images.theta[[0] * n]

    mode = Mode(images.theta[0], 0.0, np.eye(prior.dim))
    monkeypatch.setattr(inference, "posterior_modes", lambda *args: [mode])
    monkeypatch.setattr(inference, "mixture_draws", draws)
    reconstruct(observed(images, 0), category, draws=2)
    assert threads == [1]


def test_the_best_of_each_direction_goes_on_first(animal) -> None:
    """Quarter turns, of which those to the sides are divided at 90°."""
    _, prior, _ = animal
    yaw = np.radians([0, 30, -40, 80, 100, 50, 180, -91])
    theta = torch.as_tensor(prior.facing(np.zeros((8, prior.dim)), yaw))
    reached = [(point, -float(k)) for k, point in enumerate(theta)]
    order = [int(-value) for _, value in refinement._diverse(prior, reached)]
    assert order == [0, 3, 4, 6, 7, 1, 5, 2]


@pytest.mark.parametrize(("softness", "difference"), [(1.0, 0.05), (2.0, 0.1), (8.0, 0.15)])
def test_differences_are_larger_for_soft_likelihoods(animal, monkeypatch, softness, difference):
    _, prior, images = animal
    likelihood = replace(
        ImageLikelihood.of(observed(images, 0), 32, torch.float64, np.zeros(0)), softness=softness
    )
    # Images whose only pixel is the sum of squares of θ: its difference is 2 θ + h.
    monkeypatch.setattr(refinement, "_images", lambda prior, theta, _: (theta**2).sum(dim=1))
    theta = torch.linspace(-1, 1, 5, dtype=torch.float64)
    found = refinement._derivatives(prior, theta, (theta**2).sum(), likelihood)
    np.testing.assert_allclose(found, 2 * theta + difference)


def test_draws_of_a_mode_have_its_moments() -> None:
    rng = np.random.default_rng(0)
    factor = rng.standard_normal((3, 3))
    precision = factor @ factor.T + np.eye(3)
    mode = Mode(np.arange(3.0), -2.0, precision)
    draws = mode.draw(rng, 200_000)
    np.testing.assert_allclose(draws.mean(axis=0), mode.theta, atol=0.01)
    np.testing.assert_allclose(np.cov(draws.T), np.linalg.inv(precision), atol=0.01)
    volume = np.sqrt((2 * np.pi) ** 3 / np.linalg.det(precision))
    assert mode.log_evidence == pytest.approx(-2.0 + np.log(volume))


def test_evidence_decides_between_modes_but_not_fully() -> None:
    high, wide = np.eye(1), 0.01 * np.eye(1)
    modes = [Mode(np.array([100.0]), 0.0, high), Mode(np.array([-100.0]), -3.0, wide)]
    evidence_ratio = np.exp(-3.0) * 10  # ten times as wide
    draws = inference.mixture_draws(modes, np.random.default_rng(0), 40_000)
    odds = (draws < 0).mean() / (draws > 0).mean()
    assert evidence_ratio < 0.9 * odds < odds < 0.9
    assert odds == pytest.approx(evidence_ratio**inference._CONFIDENCE, rel=0.05)


def test_reconstruction_covers_the_mask_and_is_near_the_truth(animal) -> None:
    category, prior, made = animal
    result = reconstruct(observed(made, 0), category, draws=20, seed=1)
    assert result.mask_iou > 0.75
    assert result.trusted
    truth = prior.motion(made.theta[:1])[0, 0]
    middle = truth - truth.mean(axis=0)
    # Draws also face elsewhere, so that their mean is of no body.
    joints = result.prior.motion(result.theta)[0]
    joints = joints - joints.mean(axis=0)
    error = np.linalg.norm(joints - middle, axis=-1).mean()
    turned = np.linalg.norm(joints * [-1, 1, -1] - middle, axis=-1).mean()
    assert error < 0.5 * turned


@pytest.mark.parametrize(
    ("power", "expected"),
    [
        pytest.param(2, {"silhouette", "shape"}, marks=pytest.mark.slow, id="disc"),
        pytest.param(100, {"shape"}, id="square"),
    ],
)
def test_a_silhouette_of_something_else_is_not_trusted(animal, power, expected) -> None:
    """Only bodies of unusual shapes cover a disc or a square, and the disc not closely."""
    category, _, _ = animal
    place = np.abs(2 * (np.arange(SIZE) + 0.5) / SIZE - 1)
    mask = (place**power + place[:, None] ** power < 0.8**power).astype(float)
    other = ImageObservation(mask[None], None, None, TANGENT, np.eye(3)[None])
    result = reconstruct(other, category, draws=2)
    failed = {check.name for check in result.checks if not check.passed}
    assert expected <= failed
    assert ("no body" in result.summary()[0]) == ("silhouette" in failed)
    assert "surface" in result.summary()[0]


@pytest.mark.parametrize(
    ("starts", "width", "rows", "area", "outline"),
    [
        ([8], 48, SIZE, 48 * 48, 4 * 48),
        ([8], 48, 32, 48 * 24, 48 + 2 * 24),
        ([8, 24, 40], 8, SIZE, 3 * 48 * 8, 3 * 2 * (48 + 8)),
    ],
    ids=["square", "half unknown", "bars"],
)
def test_errors_of_silhouettes_are_relative_to_the_outline(
    animal, starts, width, rows, area, outline
) -> None:
    """The factor of 1 − IoU is 1 for a square, also of two equal images, and less for bars."""
    category, single, made = animal
    mask = np.zeros((2, SIZE, SIZE))
    for start in starts:
        mask[:, 8:56, start : start + width] = 1
    mask[:, rows:] = np.nan
    rotation = np.tile(np.eye(3), (2, 1, 1))
    observation = ImageObservation(mask, None, None, np.repeat(TANGENT, 2), rotation)
    prior = SurfacePrior(category, observation.tangent)
    theta = np.concatenate([made.theta[0], np.zeros(prior.dim - single.dim)])
    result = Reconstruction(observation, prior, theta, np.stack([theta, theta]), ())
    expected = (1 - result.mask_iou) * 4 * np.sqrt(area) / outline
    assert _outline_error(result) == pytest.approx(expected)


def test_a_second_body_in_the_mask_is_uncovered() -> None:
    """The check is the radius of the largest disc of the mask beside the silhouette."""
    y, x = np.mgrid[:SIZE, :SIZE]
    body, radius = np.hypot(x - 40, y - 36) < 20, 6.0
    other = np.hypot(x - 8, y - 8) < radius

    def radius_of(*masks: np.ndarray) -> float:
        mask = np.where(y < SIZE - 2, np.stack(masks).astype(float), np.nan)
        result = SimpleNamespace(
            observation=SimpleNamespace(mask=mask), silhouette=np.stack([body] * len(masks))
        )
        return _uncovered_radius(result)

    assert radius_of(body) == 0
    alone = radius / np.sqrt((body | other).sum())
    assert radius_of(body | other) == pytest.approx(alone, rel=0.05)
    assert radius_of(body, body | other) == pytest.approx(alone / 2, rel=0.05)
    assert radius_of(body | other) > _UNCOVERED
    # A band one pixel wide along the outline is an error of the mask.
    assert radius_of(ndimage.binary_dilation(body)) < _UNCOVERED


@pytest.mark.slow
def test_intervals_hold(animal) -> None:
    """Those of 90 %, of joints relative to their middle in the size of the truth."""
    category, prior, _ = animal
    made = make_images(prior, np.random.default_rng(11), 8, SIZE)
    inside = []
    for k in range(len(made.theta)):
        result = reconstruct(observed(made, k), category, draws=100)
        truth = prior.motion(made.theta[k])[0]
        truth = truth - truth.mean(axis=0)
        joints = result.joints - result.joints.mean(axis=1, keepdims=True)
        size = np.sqrt((truth**2).sum() / (joints**2).sum(axis=(1, 2), keepdims=True))
        low, high = np.quantile(size * joints, (0.05, 0.95), axis=0)
        inside.append(((truth >= low) & (truth <= high)).mean())
    assert 0.75 < np.mean(inside) < 0.99


@pytest.mark.slow
def test_draws_are_reproducible(animal) -> None:
    category, _, made = animal
    one, other = (reconstruct(observed(made, 0), category, draws=3, seed=1) for _ in range(2))
    np.testing.assert_array_equal(one.draws, other.draws)


@pytest.mark.slow
def test_a_clip_is_reconstructed_as_one_motion(animal) -> None:
    category, _, _ = animal
    clip = SurfacePrior(category, np.repeat(TANGENT, 2))
    theta = make_images(SurfacePrior(category, TANGENT), np.random.default_rng(5), 1, SIZE).theta
    theta = np.concatenate([theta, np.zeros((1, clip.dim - theta.shape[1]))], axis=1)
    with torch.no_grad():
        images = clip.render(torch.as_tensor(theta), SIZE)[0].numpy()
    rotation = np.tile(np.eye(3), (2, 1, 1))
    mask = (images[..., 3] > 0.5).astype(float)
    observation = ImageObservation(mask, None, None, clip.tangent, rotation)
    result = reconstruct(observation, category, draws=2)
    assert result.draws.shape == (2, clip.dim)
    assert result.mask_iou > 0.7


def test_draws_must_be_at_least_two(animal) -> None:
    category, _, made = animal
    with pytest.raises(ValueError, match="draws"):
        reconstruct(observed(made, 0), category, draws=1)

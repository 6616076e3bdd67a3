"""Bodies posed in front of a camera, their images and the density of observed ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt, maximum_filter
from scipy.spatial.transform import Rotation

from probmotion.models.images.image_likelihood import ImageLikelihood
from probmotion.models.images.made_images import make_images, with_made_features
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.posing import shaded
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.models.latent.turn_code import TurnCode
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.reconstruction.moving_surface import surface_frames
from probmotion.samplers import SequentialMonteCarlo
from tests.models.images.meshes import icosphere

SIZE, TANGENT = 64, 0.15


@pytest.fixture(scope="module")
def prior(category):
    return SurfacePrior(category, np.array([TANGENT]))


@pytest.fixture(scope="module")
def made(prior):
    return make_images(prior, np.random.default_rng(0), 6, SIZE)


@pytest.fixture(scope="module")
def cases(category, prior, made):
    """Prior and made images without and with three features."""
    other = SurfacePrior(with_made_features(category, 3), np.array([TANGENT]))
    described = make_images(other, np.random.default_rng(0), 2, SIZE)
    return {"colours": (prior, made), "features": (other, described)}


def observed(made, k: int) -> ImageObservation:
    features = None if made.features is None else made.features[k][None]
    return ImageObservation(
        made.mask[k][None], made.rgb[k][None], features, np.array([TANGENT]), np.eye(3)[None]
    )


def test_surface_moves_with_the_body(category) -> None:
    """At rest it is the rest surface; a bone's turn moves its vertices rigidly."""
    body, surface = category.body, category.surface
    rest = torch.as_tensor(surface.vertices)[None]
    turns = torch.zeros(1, 1, len(body.bones), 3, dtype=torch.float64)
    still = (torch.eye(3, dtype=torch.float64)[None, None], torch.zeros(1, 1, 3).double())
    lengths = torch.zeros(1, body.n_groups, dtype=torch.float64)
    posed = category.skin.posed(rest, turns, *still, lengths)
    torch.testing.assert_close(posed[0, 0], rest[0], rtol=0, atol=1e-12)

    elbow = body.skeleton.joint_names.index("left_elbow")
    turns[..., body.bones.index("left_elbow"), 0] = 0.7
    posed = category.skin.posed(rest, turns, *still, lengths)[0, 0].numpy()
    joints = body.positions(turns, *still, lengths)[0, 0].numpy()
    wrist = body.skeleton.joint_names.index("left_wrist")
    own = surface.weights[np.arange(len(rest[0])), (surface.joints == wrist).argmax(axis=1)]
    rigid = np.flatnonzero((surface.joints == wrist).any(axis=1) & (own > 0.999))
    assert len(rigid) > 2
    before = surface.vertices[rigid] - body.rest_positions[elbow]
    after = posed[rigid] - joints[elbow]
    np.testing.assert_allclose(
        np.linalg.norm(after, axis=1), np.linalg.norm(before, axis=1), rtol=1e-3
    )
    assert np.abs(after - before).max() > 0.02


def test_joints_are_inside_the_silhouette(prior, made) -> None:
    joints = prior.motion(made.theta)[:, 0] * [1.0, -1.0, -1.0]
    with torch.no_grad():
        images = prior.render(torch.as_tensor(made.theta), SIZE)[:, 0, ..., 3]
    places = joints[..., :2] / (joints[..., 2:] * TANGENT)
    cells = np.floor(0.5 * SIZE * (1 + places)).astype(int)
    inside = ((cells >= 0) & (cells < SIZE)).all(axis=-1)
    rows = np.arange(len(joints))[:, None]
    x, y = np.moveaxis(cells.clip(0, SIZE - 1), -1, 0)
    # Paws are hardly wider than a pixel.
    near = maximum_filter(images.numpy(), (1, 3, 3))[rows, y, x]
    assert near[inside].mean() > 0.94
    mirrored = maximum_filter(images.numpy()[..., ::-1], (1, 3, 3))[rows, y, x]
    assert mirrored[inside].mean() < 0.9


def test_made_bodies_fill_the_crop_and_are_cut_off_at_one_side(prior) -> None:
    made = make_images(prior, np.random.default_rng(1), 60, SIZE)
    unknown = np.isnan(made.mask).any(axis=(1, 2))
    assert 0.05 < unknown.mean() < 0.5
    body = np.nan_to_num(made.mask) >= 0.5
    rows, columns = body.any(axis=2), body.any(axis=1)
    larger = np.maximum(rows.sum(axis=1), columns.sum(axis=1)) / SIZE
    assert larger.mean() == pytest.approx(1 / 1.25, abs=0.05)


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, -2.5])
def test_bodies_face_where_they_are_told(prior, yaw: float) -> None:
    theta = prior.facing(np.zeros((1, prior.dim)), np.array([yaw]))
    joints = prior.motion(theta)[0, 0]
    names = prior.skeleton.joint_names
    ahead = joints[names.index("neck")] - joints[names.index("pelvis")]
    # X is the image's right, Z towards the camera.
    assert math.atan2(ahead[0], ahead[2]) == pytest.approx(yaw, abs=0.3)


@pytest.mark.parametrize("case", ["colours", "features"])
def test_density_has_the_derivative_of_finite_differences(cases, case) -> None:
    prior, made = cases[case]
    posterior = MotionPosterior(prior, observed(made, 0))
    theta = torch.as_tensor(made.theta[:1]).requires_grad_()
    value = posterior.log_density(theta)
    value.sum().backward()
    assert theta.grad is not None
    rng = np.random.default_rng(2)
    for _ in range(3):
        direction = rng.standard_normal(prior.dim)
        step = 1e-6 * direction
        ends = posterior.log_density(made.theta[:1] + np.array([[1], [-1]]) * step)
        slope = float((ends[0] - ends[1]) / 2e-6)
        assert float((theta.grad[0].numpy() * direction).sum()) == pytest.approx(slope, rel=0.05)
    prior_density = prior.log_density(made.theta[:1])
    likelihood = prior.log_likelihood(made.theta[:1], observed(made, 0))
    assert value.item() == pytest.approx(float(prior_density[0] + likelihood[0]), rel=1e-6)


def test_images_do_not_depend_on_the_batch(prior, made) -> None:
    observation = observed(made, 0)
    together = prior.log_likelihood(made.theta, observation)
    alone = [prior.log_likelihood(theta[None], observation)[0] for theta in made.theta]
    np.testing.assert_allclose(together, alone, rtol=1e-9)
    assert np.argmax(together) == 0


@pytest.mark.parametrize("case", ["colours", "features"])
def test_curvature_has_the_gradient_of_the_density(cases, case) -> None:
    prior, made = cases[case]
    theta = torch.as_tensor(made.theta[0]).requires_grad_()
    likelihood = ImageLikelihood.of(
        observed(made, 1), SIZE, torch.float64, prior.category.feature_noise
    )
    images = prior.render(theta[None], SIZE, case == "features")[0]
    likelihood.log_density(images[None]).sum().backward()
    step = 1e-6
    moved = torch.stack([theta.detach() + step * row for row in torch.eye(prior.dim).double()])
    with torch.no_grad():
        derivatives = (prior.render(moved, SIZE, case == "features") - images) / step
    slope, information = likelihood.curvature(images.detach(), derivatives)
    torch.testing.assert_close(slope, theta.grad, rtol=0.02, atol=0.02)
    assert float(torch.linalg.eigvalsh(information).min()) > -1e-6
    # That of features is of pixels inside the mask.
    alone = replace(likelihood, features=likelihood.features[..., :0], feature_noise=slope[:0])
    _, without = alone.curvature(
        images[..., [0, 1, 2, -1]].detach(), derivatives[..., [0, 1, 2, -1]]
    )
    rows = derivatives[:, likelihood.known & (likelihood.mask > 0.5), 3:-1]
    rows = (rows / likelihood.feature_noise).flatten(1)
    torch.testing.assert_close(information - without, 0.05 * rows @ rows.T)


def test_particles_find_the_body(prior) -> None:
    """Draws of the prior are annealed to bodies as probable as the true one, and alike."""
    made = make_images(prior, np.random.default_rng(0), 1, 16)
    posterior = MotionPosterior(prior, observed(made, 0))
    sampler = SequentialMonteCarlo(particles=32, candidates=200, gradients=False)
    draws = sampler.sample(posterior, draws=32, seed=1, progress=False)
    truth = float(posterior.log_density(made.theta)[0])
    first = posterior.log_density(prior.initial(np.random.default_rng(1), 200))
    assert np.max(first) < truth - 100
    assert np.median(draws.dataset["log_density"]) > truth - prior.dim
    theta = draws.dataset["theta"].values[0]
    with torch.no_grad():
        seen = prior.render(torch.as_tensor(theta).float(), 16)[:, 0, ..., -1].numpy() > 0.5
    mask = made.mask[0] > 0.5
    overlap = (seen & mask).sum(axis=(1, 2)) / (seen | mask).sum(axis=(1, 2))
    assert np.median(overlap) > 0.6
    assert np.cos(prior.yaw(theta) - prior.yaw(made.theta)).mean() > 0.5


def test_features_have_a_gaussian_density(cases) -> None:
    """Inside the mask, with the noise of the category; without those that are NaN."""
    prior, _ = cases["features"]
    category = prior.category
    made = make_images(prior, np.random.default_rng(4), 1, 2 * SIZE)
    features = made.features.copy()
    rows, columns = np.nonzero(np.nan_to_num(made.mask[0]) > 0.9)
    features[0, rows[::7], columns[::7]] = np.nan
    whole = ImageObservation(made.mask, None, features, prior.tangent, np.eye(3)[None])
    theta = made.theta + 0.1
    with torch.no_grad():
        image = prior.render(torch.as_tensor(theta), SIZE, True)[0, 0].numpy()
    total, unknown = 0.0, 0
    for y in range(SIZE):
        for x in range(SIZE):
            block = np.s_[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
            mask, values = made.mask[0][block], features[0][block]
            if np.isnan(mask).any() or mask.mean() <= 0.5:
                continue
            mean = (mask[..., None] * values).mean(axis=(0, 1))
            unknown += np.isnan(mean[0])
            errors = (mean - image[y, x, 3:6]) / (2 * category.feature_noise)
            total += 0 if np.isnan(mean[0]) else -0.5 * (errors**2).sum()
    assert unknown > 20
    rows = torch.as_tensor(image)[None, None]
    soft = ImageLikelihood.of(whole, SIZE, torch.float64, category.feature_noise, 2.0)
    alone = replace(soft, features=soft.features[..., :0], feature_noise=soft.feature_noise[:0])
    difference = soft.log_density(rows) - alone.log_density(rows[..., [0, 1, 2, 6]])
    assert difference.item() == pytest.approx(0.05 * total, rel=1e-5)


def test_features_are_not_shaded(cases) -> None:
    """They do not change with light and colours, nor colours and coverage with them."""
    prior, made = cases["features"]
    theta = torch.as_tensor(made.theta[:1]).clone()
    image = prior.render(theta, SIZE, True)
    torch.testing.assert_close(image[..., [0, 1, 2, 6]], prior.render(theta, SIZE))
    theta[:, prior.layout.albedo.start : prior.layout.light.stop] += 1.0
    other = prior.render(theta, SIZE, True)
    torch.testing.assert_close(other[..., 3:], image[..., 3:])
    assert (other[..., :3] - image[..., :3]).abs().max() > 0.05


def test_features_tell_front_from_back(category) -> None:
    """A symmetric body from far away has nearly the same silhouette from both sides."""
    still = replace(category.code, mean=0 * category.code.mean)
    prior = SurfacePrior(replace(with_made_features(category, 3), code=still), np.array([0.02]))
    level = np.zeros((2, prior.dim))
    level[:, prior.layout.view.start + 2] = -0.75
    for yaw in (0.0, np.pi):
        made = make_images(prior, np.random.default_rng(0), 2, SIZE, prior.facing(level, yaw))
        for k, theta in enumerate(made.theta):
            pair = np.stack([theta, prior.facing(theta, np.pi - yaw)])
            mask = ImageObservation(made.mask[k][None], None, None, prior.tangent, np.eye(3)[None])
            full = replace(mask, features=made.features[k][None])
            assert abs(np.subtract(*prior.log_likelihood(pair, mask))) < 8
            assert np.subtract(*prior.log_likelihood(pair, full)) > 100


def test_features_of_others_are_refused(cases) -> None:
    (plain, _), (described, made) = cases["colours"], cases["features"]
    whole = observed(made, 0)
    bare = replace(whole, features=None)
    # Without features in the image, those of the category make no difference.
    values = [prior.log_likelihood(made.theta, bare) for prior in (plain, described)]
    np.testing.assert_array_equal(*values)
    MotionPosterior(described, bare)
    with pytest.raises(
        ValueError, match=r"be left out for the category \w+, got 3 channels; train"
    ):
        MotionPosterior(plain, whole)
    fewer = replace(whole, features=whole.features[..., :2])
    with pytest.raises(
        ValueError, match=r"have 3 channels for the category \w+, got 2 channels; train"
    ):
        MotionPosterior(described, fewer)


def test_backgrounds_are_behind_the_bodies(prior, made) -> None:
    """Pixels have the colours of the body and of the background by the body's share of them."""
    with torch.no_grad():
        images = prior.render(torch.as_tensor(made.theta).float(), SIZE)[:, 0].double().numpy()
    colours, share = images[..., :3], images[..., 3]
    known = np.isfinite(made.mask)
    inside, outside = np.abs(share - 1) < 1e-3, share == 0
    both = (share > 0.1) & (share < 0.9)
    np.testing.assert_allclose(
        made.rgb[inside & known], np.clip(colours[inside & known], 0, 1), atol=1e-3
    )
    behind = (made.rgb - colours)[both & known] / (1 - share[both & known])[:, None]
    nearest = np.array(
        [distance_transform_edt(~each, return_indices=True)[1] for each in outside & known]
    )
    frame, row, column = np.nonzero(both & known)
    beside = made.rgb[frame, nearest[frame, 0, row, column], nearest[frame, 1, row, column]]
    assert np.abs(behind - beside).mean() < 0.03  # the background is smooth
    seen = [made.rgb[k][outside[k] & known[k]] for k in range(len(share))]
    assert np.std([each.mean(axis=0) for each in seen], axis=0).min() > 0.1
    assert min(each.std(axis=0).max() for each in seen) > 0.05


def test_made_images_with_features(cases) -> None:
    """Masks and colours are those without; features have the category's noise."""
    (bare, _), (prior, _) = cases["colours"], cases["features"]
    rngs = [np.random.default_rng(0) for _ in range(2)]
    plain, again = (
        make_images(each, rng, 6, SIZE) for each, rng in zip((bare, prior), rngs, strict=True)
    )
    assert plain.features is None
    assert rngs[0].random() == rngs[1].random()
    np.testing.assert_array_equal(again.mask, plain.mask)
    np.testing.assert_array_equal(again.rgb, plain.rgb)
    np.testing.assert_array_equal(np.isnan(again.features[..., 0]), np.isnan(again.mask))
    with torch.no_grad():
        images = prior.render(torch.as_tensor(again.theta).float(), SIZE, True)[:, 0].numpy()
    inside = (images[..., -1] > 0.999) & np.isfinite(again.mask)
    noise = (again.features - images[..., 3:6])[inside]
    assert noise.std(axis=0) == pytest.approx(prior.category.feature_noise, rel=0.15)
    features = prior.category.features
    np.testing.assert_allclose(features.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(features.T @ features / len(features), np.eye(3), atol=1e-9)
    vertices = prior.category.surface.vertices
    other = np.abs((vertices * [-1, 1, 1])[:, None] - vertices).sum(axis=-1).argmin(axis=1)
    np.testing.assert_allclose(features[other], features, atol=1e-6)


def test_unknown_pixels_do_not_count(prior, made) -> None:
    whole = observed(made, 2)
    mask = whole.mask.copy()
    mask[:, :, : SIZE // 2] = np.nan
    part = ImageObservation(mask.copy(), whole.rgb, None, whole.tangent, whole.rotation)
    mask[:, :, : SIZE // 2] = 1.0 - whole.mask[:, :, : SIZE // 2]
    values = [prior.log_likelihood(made.theta[2:3], each)[0] for each in (whole, part)]
    wrong = ImageObservation(mask.clip(0, 1), whole.rgb, None, whole.tangent, whole.rotation)
    assert prior.log_likelihood(made.theta[2:3], wrong)[0] < values[0] < values[1]


def test_the_path_of_a_clip_begins_at_the_first_pose(category) -> None:
    clip = SurfacePrior(category, np.full(3, TANGENT))
    single = SurfacePrior(category, np.array([TANGENT]))
    rng = np.random.default_rng(3)
    theta = clip.initial(rng, 2)
    first = np.delete(theta, np.s_[single.dim :], axis=1)
    with torch.no_grad():
        images = clip.render(torch.as_tensor(theta), 32)
        alone = single.render(torch.as_tensor(first), 32)
    torch.testing.assert_close(images[:, :1], alone)
    still = theta.copy()
    still[:, single.dim :] = 0.0
    with torch.no_grad():
        vertices = clip.parameters(torch.as_tensor(still)).rotation
    torch.testing.assert_close(vertices[:, 0], vertices[:, 2])
    with pytest.raises(ValueError, match="at most 10"):
        SurfacePrior(category, np.full(11, TANGENT))


def test_crops_of_a_clip_have_their_own_axes(category) -> None:
    """A camera that follows a still body turns; the body does not."""
    axis, angle = np.array([0.2, 1.0, -0.1]), np.radians([5.0, 20.0, 40.0])
    rotation = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    tangent = TANGENT * np.array([1.0, 1.2, 0.9])
    clip = SurfacePrior(category, tangent, rotation=rotation)
    theta = clip.initial(np.random.default_rng(4), 1)
    theta[:, clip.layout.view.start + 7 :] = 0.0
    p = clip.parameters(torch.as_tensor(theta))
    torch.testing.assert_close(p.rotation[:, 0], p.rotation[:, 2])
    seen = clip.vertices(torch.as_tensor(theta))[0].numpy()
    common = surface_frames(clip, theta)[0, :3] * [1.0, -1.0, -1.0]
    # Points in the axes of the image, which both crops and motions turn.
    np.testing.assert_allclose(seen @ rotation, common @ rotation[0], atol=1e-9)
    middle = (p.translation + p.rotation @ torch.as_tensor(clip._middle))[0].numpy()
    in_crop = ((middle @ rotation[0])[:, None] @ rotation.swapaxes(1, 2))[:, 0]
    # It keeps its distance, and its place in units of the crop.
    scale = np.stack([tangent / TANGENT, tangent / TANGENT, np.ones(3)], axis=1)
    np.testing.assert_allclose(in_crop, clip.middle(theta) * scale, atol=1e-9)
    mask = np.pad(np.ones((3, 16, 16)), ((0, 0), (8, 8), (8, 8)))
    other = ImageObservation(mask, None, None, clip.tangent, rotation[::-1])
    with pytest.raises(ValueError, match="the prior's rotation, got a difference of 1"):
        clip.check_observations(other)


def test_a_clip_follows_estimates_of_its_images(category) -> None:
    """Estimates of each image alone, in its crop's axes, become the clip that they are of."""
    code = category.code
    same = replace(code, mean=0 * code.mean, basis=np.repeat(code.basis[:, :1], 10, axis=1))
    angle = np.radians([0.0, 3.0, 8.0])
    clip = SurfacePrior(
        replace(category, code=same),
        TANGENT * np.array([1.0, 1.1, 0.9]),
        rotation=Rotation.from_rotvec(angle[:, None] * [0.2, 1.0, -0.1]).as_matrix(),
    )
    theta = clip.initial(np.random.default_rng(5), 1)[0]
    theta[clip.layout.view.start + 7 :] *= 0.3
    p, view = clip.parameters(torch.as_tensor(theta[None])), clip.layout.view
    alone = np.tile(theta[: view.start + 7], (3, 1))
    middle = (p.translation + p.rotation @ torch.as_tensor(clip._middle))[0].numpy()
    for t in range(3):
        roll, pitch, yaw = Rotation.from_matrix(
            clip.turned[t] @ p.rotation[0, t].numpy() @ np.diag([1.0, -1.0, -1.0])
        ).as_euler("ZXY")
        x, y, z = clip.turned[t] @ middle[t]
        width = z * clip.tangent[t]
        alone[t, view] = [
            math.sqrt(2) * np.sin(-yaw), math.sqrt(2) * np.cos(-yaw), (pitch - 0.15) / 0.2,
            roll / 0.08, x / width / 0.11, (y / width + 0.12) / 0.11,
            (np.log(width) - np.log(0.58)) / 0.18,
        ]  # fmt: skip
    followed = clip.followed(alone)
    again = clip.parameters(torch.as_tensor(followed[None]))
    torch.testing.assert_close(again.rotation, p.rotation)
    torch.testing.assert_close(again.translation, p.translation)
    torch.testing.assert_close(again.rest_vertices, p.rest_vertices)
    jump = np.copy(alone)  # which is reached later, by one standard deviation per image
    jump[1:, view.start + 4] += 0.09 / 0.11
    x = clip.followed(jump)[view][[10, 16]] - followed[view][[10, 16]]
    np.testing.assert_allclose(followed[view][10] + x[0], 1.0)
    np.testing.assert_allclose(0.06 * x.sum(), 0.09)
    kept = followed[clip.layout.code] @ theta[clip.layout.code]
    assert 0.5 < kept / (theta[clip.layout.code] ** 2).sum() < 1


def test_bodies_mirrored_in_depth(category) -> None:
    """From far away, all joints are where their counterparts were, at the opposite depth."""
    bones = len(category.body.bones)
    # A code that has all poses.
    basis = 2.0 * np.eye(3 * bones).reshape(-1, 1, bones, 3)
    code = TurnCode(category.code.mean[:1], basis, 10.0)
    far = SurfacePrior(replace(category, code=code), np.array([1e-4]))
    theta = far.initial(np.random.default_rng(6), 3)
    theta[:, far.layout.code] *= 0.1

    def relative(theta: np.ndarray) -> np.ndarray:
        """Return the joints relative to their middle, (n, J, 3)."""
        joints = far.motion(theta)[:, 0]
        return joints - joints.mean(axis=1, keepdims=True)

    order = list(category.body.skeleton.mirrored_order)
    before, after = relative(theta)[:, order], relative(far.mirrored(theta))
    np.testing.assert_allclose(after, before * [1.0, 1.0, -1.0], atol=3e-3)
    assert np.abs(after - before).max() > 0.5


def test_light_from_one_side(prior) -> None:
    """Lambert's law on a ball: ambient behind, ambient plus the cosine in front."""
    vertices, triangles = icosphere(3)
    points = torch.tensor(vertices)[None]
    light, ambient = torch.tensor([[0.0, 0.0, 0.6]]).double(), torch.tensor([0.3]).double()
    radiance = shaded(points, triangles, torch.ones_like(points), light, ambient)[0, :, 0]
    expected = 0.3 + 0.6 * points[0, :, 2].clamp(min=0)
    torch.testing.assert_close(radiance, expected, rtol=0, atol=0.01)


def test_the_second_renderer_gives_the_same_images(cases) -> None:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    from probmotion.models.images.mitsuba_renderer import MitsubaRenderer

    prior, made = cases["features"]
    theta = torch.as_tensor(made.theta)
    try:
        other = SurfacePrior(prior.category, np.array([TANGENT]), MitsubaRenderer(256))
        images = other.render(theta, SIZE, True)
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"LLVM is not installed: {error}")
    own = prior.render(theta, SIZE, True)
    coverage = (images[..., -1] - own[..., -1]).abs()
    assert float(coverage.sum() / own[..., -1].sum()) < 0.03
    assert float((images[..., :3] - own[..., :3]).abs().mean()) < 0.002
    inside = (images[..., -1] > 0.999) & (own[..., -1] > 0.999)
    features = (images - own)[inside][:, 3:-1].abs().mean()
    assert float(features / own[inside][:, 3:-1].abs().mean()) < 0.01

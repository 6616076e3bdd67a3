"""Figures of reconstructions of made images: true motions, priors of ablations, and errors."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from probmotion.geometry.rotations import vector_to_matrix
from tests.models.images.bodies import small_quadruped

SCRIPTS = Path(__file__).parents[1] / "benchmarks"
FRAMES = 10


@pytest.fixture(scope="module")
def category():
    return small_quadruped()


@pytest.fixture(scope="module")
def script(category):
    """Return the module; a small category, and a random motion of each window."""
    from probmotion.models.bodies.turn_fit import TurnFit

    def random_fit(body, windows):
        seeds = [int(1e6 * np.abs(window).sum()) for window in windows]
        rngs, path = [np.random.default_rng(seed) for seed in seeds], np.linspace(0, 1, FRAMES)

        def normal(*shape):
            return np.array([rng.normal(size=shape) for rng in rngs])

        moved = path[:, None] * normal(2, 1, 3)
        return TurnFit(
            0.3 * normal(FRAMES, len(body.bones), 3),
            vector_to_matrix(moved[:, 0]),
            moved[:, 1],
            0.1 * normal(body.n_groups),
            0.0,
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPTS)
        bodies = importlib.import_module("made_bodies")
        patch.setattr(bodies.Category, "load", lambda name: category)
        patch.setattr(bodies, "encoder_of", lambda category: None)
        patch.setattr(bodies, "fit_turns", random_fit)
        patch.setattr(bodies, "SIZE", 64)
        yield importlib.import_module("image_figures")


def test_clips_show_the_held_out_motion_from_a_constant_direction(script):
    bodies = script.Bodies("quadruped", None, "validation", 2)
    observation, joints, *_ = bodies.clip(1)
    assert observation.images == FRAMES
    expected = bodies.category.body.positions(*(part[1] for part in bodies.fit[:4]))
    seen, moved = (each - each.mean(axis=1, keepdims=True) for each in (joints, expected))
    left, _, right = np.linalg.svd(np.einsum("tji,tjk->ik", seen, moved))
    rotation = left @ right
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(seen, moved @ rotation.T, atol=1e-9)


def test_images_of_a_body_do_not_depend_on_the_number_of_bodies(script):
    few, many = (script.Bodies("quadruped", None, "validation", n).image(0) for n in (1, 3))
    np.testing.assert_array_equal(few.observation.rgb, many.observation.rgb)
    np.testing.assert_array_equal(few.joints, many.joints)


def test_a_prior_of_independent_rotations_has_the_spreads_of_the_code(script, category):
    prior = script.SurfacePrior(category, np.array([0.15]))
    theta = prior.initial(np.random.default_rng(0), 4000)
    apart, same = script.independent(prior, theta[:5])
    np.testing.assert_allclose(apart.motion(same)[:, 0], prior.motion(theta[:5])[:, 0], atol=1e-12)
    drawn = apart.category.code.turns(same[:1, apart.layout.code] * 0)
    np.testing.assert_allclose(drawn[0, 0], category.code.mean[0])
    z = np.random.default_rng(1).normal(size=(4000, apart.category.code.dim))
    turns, coded = apart.category.code.turns(z), category.code.turns(theta[:, prior.layout.code])
    np.testing.assert_allclose(turns[:, 0].std(axis=0), coded[:, 0].std(axis=0), rtol=0.1)
    correlation = np.corrcoef(turns[:, 0].reshape(4000, -1).T)
    assert np.abs(correlation - np.eye(len(correlation))).max() < 0.1


def test_depth_counts_in_velocity_errors_in_space_alone(script):
    truth = np.random.default_rng(0).normal(size=(FRAMES, 7, 3))
    truth -= truth.mean(axis=1, keepdims=True)
    truth /= np.linalg.norm(truth, axis=(1, 2), keepdims=True)  # of one size
    still = script.joint_errors(truth[:1].repeat(FRAMES, 0), truth, 1.0)
    names = ("velocity_error", "velocity_error_3d", "speed_ratio")
    assert [still[name] for name in names] == pytest.approx([1, 1, 0])
    mirrored = script.joint_errors(3 * truth * [1, 1, -1], truth, 1.0)  # another size
    step = np.diff(truth, axis=0)
    share = np.linalg.norm(2 * step[..., 2], axis=1) / np.linalg.norm(step, axis=(1, 2))
    assert mirrored["velocity_error"] == pytest.approx(0, abs=1e-9)
    assert mirrored["velocity_error_3d"] == pytest.approx(share.mean())
    assert mirrored["speed_ratio"] == pytest.approx(1)


def test_the_code_reproduces_its_own_motions(script, category):
    bodies = script.Bodies("quadruped", None, "validation", 2)
    motion = category.code.turns(np.linspace(-1, 1, category.code.dim))
    bodies.fit.turns[:] = motion
    np.testing.assert_allclose(bodies.reproduced(0), motion, atol=1e-12)
    errors = dict(script.of_code(bodies, 2))
    assert errors["joint_error_share_of_length_of_code"] == pytest.approx(0, abs=1e-12)


def test_directions_are_missed_if_few_draws_face_in_them(script):
    behind = np.full(100, np.radians(-175.0))
    behind[:5] = 0.1
    assert [script.direction_missed(behind, np.radians(yaw)) for yaw in (160, 30, 90)] == [0, 0, 1]
    assert script.direction_missed(behind[1:], np.radians(30.0)) == 1
    bodies = script.Bodies("quadruped", None, "validation", 1)
    _, prior, theta = bodies._posed(0, bodies.fit.turns[0, :1])
    faced = prior.facing(theta, bodies.image(0).yaw)
    np.testing.assert_allclose(prior.motion(faced), prior.motion(theta), atol=1e-9)


def test_a_second_body_is_smaller_and_beside_the_first(script, monkeypatch):
    made = importlib.import_module("made_bodies")

    def box(rows, columns, grey):
        mask = np.zeros((1, 64, 64))
        mask[0, rows, columns] = 1
        rgb = np.full((1, 64, 64, 3), grey)
        return made.ImageObservation(mask, rgb, None, np.array([0.15]), np.eye(3)[None])

    first = box(slice(10, 50), slice(15, 45), 0.2)
    second = box(slice(4, 44), slice(20, 60), 0.8)  # 18 pixels wide and high, beside the first
    monkeypatch.setattr(made.ImageObservation, "read", lambda *args, fov: (*args, fov))
    rgb, mask, fov = made.with_second(first, second)
    assert np.tan(np.radians(fov / 2)) == pytest.approx(3 * 0.15)
    np.testing.assert_array_equal(mask[64:128, 64:109], first.mask[0][:, :45])
    other = np.argwhere((mask >= 0.5) & (rgb[..., 0] == 0.8))
    np.testing.assert_allclose(other.min(axis=0), [114 - 18, 109], atol=1)
    np.testing.assert_allclose(other.max(axis=0), [113, 109 + 18 - made.OVERLAP - 1], atol=1)


def test_people_are_those_of_recordings(script):
    with pytest.raises(ValueError, match="data must be the folder with the real motions"):
        script.Bodies("person", None, "validation", 1)


def test_keypoints_are_transferred_by_what_is_seen_of_the_surface(script, category):
    tangent, mask = 0.15, np.zeros((64, 64))
    axes = np.array([[0.0, 0, -1], [0, -1, 0], [-1, 0, 0]])  # the left side is seen

    def view(joints, surface, *, wrong=0):
        vertices = surface.vertices @ axes.T + [0, 0, 4]
        estimate = script.replace(surface, vertices=np.roll(vertices, wrong, axis=0))
        return script.View.of(joints @ axes.T + [0, 0, 4], vertices, estimate, mask, tangent)

    joints = category.body.rest_positions
    true = view(joints, category.surface)
    for left, right in category.body.skeleton.mirrored_pairs:
        sides = (left, right) if joints[left, 0] > 0 else (right, left)
        assert list(true.annotated[list(sides)]) == [True, False]
    assert true.transferred(true) == 1
    assert true.transferred(view(joints, category.surface, wrong=60)) < 0.5
    mask[:] = np.nan
    assert np.isnan(true.transferred(view(joints, category.surface)))


def test_every_ablation_changes_one_thing(script, monkeypatch):
    """What is refined without colours, shapes, hypotheses or the motion prior, or with features."""
    bodies = script.Bodies("quadruped", None, "validation", 1)
    prior = script.SurfacePrior(bodies.category, np.ones(1))
    starts = np.stack([prior.facing(np.zeros(prior.dim), yaw) for yaw in (1.5, 3.0)])
    hypotheses = starts, np.tile(starts, (3, 1))
    monkeypatch.setattr(script.inference, "encoded", lambda *args: hypotheses)
    monkeypatch.setattr(script.inference, "modes_of", lambda *args: args)
    monkeypatch.setattr(
        script.inference, "posterior_modes", lambda _, prior, seen: (prior, seen, *hypotheses)
    )

    def what(suffix):
        prior, seen, likely, drawn = script.found(bodies, bodies.image(0).observation, suffix)[1]
        assert drawn.shape == (6, prior.dim)
        assert likely.shape == (1 if suffix == "_one_hypothesis" else 2, prior.dim)
        return {
            "_without_colours": seen.rgb is None,
            "_without_shapes": bool(np.abs(prior.category.shapes).max() < 1e-6),
            "_one_hypothesis": len(likely) == 1,
            "_with_features": seen.features is not None,
            "_without_motion_prior": prior.category.code.frames == 1,
        }

    for suffix in ("", *script.ABLATIONS):
        assert what(suffix) == {name: name == suffix for name in script.ABLATIONS}

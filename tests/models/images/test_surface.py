"""Rest surfaces: topology, distance to the capsules, symmetry and weights of the shipped bodies."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import logsumexp

pytest.importorskip("torch")
pytest.importorskip("skimage", reason="scikit-image is not installed")
from probmotion import Skeleton
from probmotion.io.body_mesh import Part, body_parts
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.images._capsule_union import CapsuleUnion
from probmotion.models.images.surface import rest_surface
from probmotion.models.vae.motion_vae import MotionVAE

FLIP = np.array([-1.0, 1.0, 1.0])
THIN, SOFT = 0.02, 0.008  # smallest radius and blending length, of the extent of the rest pose


def lopsided():
    rest = np.array([[0, 0, 0], [0.3, 0.1, 0], [0.1, 0.4, 0], [0, 0.1, 0.3]])
    return ArticulatedBody(Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 1]), rest)


BODIES = {
    "animal": lambda: MotionVAE.load("animal-vae").body,
    "person": lambda: MotionVAE.load("walk-vae").body,
    "lopsided": lopsided,
}


@cache
def surface_of(name):
    body = BODIES[name]()
    return body, rest_surface(body)


@pytest.fixture(params=BODIES)
def case(request):
    return surface_of(request.param)


@pytest.fixture(params=["animal", "person"])
def symmetric(request):
    return surface_of(request.param)


def capsules(body):
    """Return the capsules of the surface, and the length over which they blend."""
    extent = np.ptp(body.rest_positions, axis=0).max()
    parts = [
        part._replace(radii=tuple(np.maximum(part.radii, THIN * extent)))
        for part in body_parts(body.skeleton, body.rest_positions)
    ]
    return parts, SOFT * extent


def heights(part, points):
    """Return how far points (V, 3) are above the surface of a capsule as if it were round, (V,)."""
    length = np.linalg.norm(part.end - part.start)
    local = (points - part.start) @ part.axes.T
    along = np.clip(local[:, 2] / length, 0, 1)
    local = (local - along[:, None] * [0, 0, length]) / [*part.flat, 1.0]
    return np.linalg.norm(local, axis=-1) - part.radii[0] * (1 - along) - part.radii[1] * along


def volume(part):
    length, (a, b) = np.linalg.norm(part.end - part.start), part.radii
    tube, caps = np.pi * length * (a * a + a * b + b * b) / 3, 2 * np.pi / 3 * (a**3 + b**3)
    return (tube + caps) * part.flat[0] * part.flat[1]


def weight_matrix(body, surface):
    """Return the weights (V, J) of all joints."""
    result = np.zeros((len(surface.vertices), body.skeleton.n_joints))
    np.add.at(result, (np.arange(len(result))[:, None], surface.joints), surface.weights)
    return result


def test_union_is_the_smooth_minimum_of_exact_distances():
    """Capsules of constant radius; slopes against finite differences."""
    parts = [
        Part(0, -1, -1, np.zeros(3), np.array([0.0, 0.3, 0.1]), (0.1, 0.1)),
        Part(0, -1, -1, np.array([0.1, 0.0, 0.0]), np.array([0.3, 0.1, 0.0]), (0.05, 0.05)),
    ]
    union, points = CapsuleUnion(parts, 0.02), np.random.default_rng(0).normal(size=(500, 3)) / 4
    distances = [
        np.linalg.norm(
            points[:, None] - start - np.linspace(0, 1, 4001)[:, None] * bone, axis=-1
        ).min(axis=1)
        for start, bone in ((part.start, part.end - part.start) for part in parts)
    ]
    expected = -0.02 * logsumexp((np.array([[0.1], [0.05]]) - distances) / 0.02, axis=0)
    near = union.at(points)
    np.testing.assert_allclose(near.values, expected, atol=1e-6)
    np.testing.assert_array_equal(union.values(points), near.values)
    shift = 1e-6 * np.eye(3)
    slopes = [(union.values(points + s) - union.values(points - s)) / 2e-6 for s in shift]
    np.testing.assert_allclose(near.slopes, np.transpose(slopes), atol=1e-5)
    assert np.abs(union.values(union.projected(points, 8))).max() < 1e-9


def test_distances_to_flat_capsules_are_exact_to_first_order():
    part = Part(0, -1, -1, np.zeros(3), np.array([0.0, 0.4, 0.1]), (0.1, 0.1), (1.5, 0.7))
    union, points = CapsuleUnion([part], 0.02), np.random.default_rng(0).normal(size=(500, 3)) / 4
    points = union.projected(points, 12)
    np.testing.assert_allclose(heights(part, points), 0, atol=1e-9)
    shift = 1e-6 * np.eye(3)
    slopes = [(union.values(points + s) - union.values(points - s)) / 2e-6 for s in shift]
    np.testing.assert_allclose(union.at(points).slopes, np.transpose(slopes), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=0), 1, atol=1e-5)


def test_surfaces_are_closed_outward_facing_spheres(case):
    body, surface = case
    edges = np.concatenate([surface.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    once = {tuple(edge) for edge in edges.tolist()}
    assert len(once) == len(edges)  # two triangles of an edge have opposite directions
    assert {(b, a) for a, b in once} == once
    assert {*surface.triangles.ravel()} == {*range(len(surface.vertices))}
    assert len(surface.vertices) - len(edges) // 2 + len(surface.triangles) == 2
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    inside = np.einsum("ti,ti->", a, np.cross(b, c)) / 6
    volumes = [volume(part) for part in capsules(body)[0]]
    assert max(volumes) < inside < sum(volumes)


def test_triangles_are_well_shaped(case):
    """Quality is 4 √3 area / Σ squared edges, 1 for an equilateral triangle."""
    _, surface = case
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    squares = sum(((x - y) ** 2).sum(axis=-1) for x, y in ((a, b), (b, c), (c, a)))
    quality = 2 * np.sqrt(3) * np.linalg.norm(np.cross(b - a, c - a), axis=-1) / squares
    assert quality.min() > 0.3
    assert np.median(quality) > 0.9


def test_limbs_reach_their_ends(case):
    """A vertex is next to the tip of each capsule that ends outside the others."""
    body, surface = case
    parts, _ = capsules(body)
    tips = 0
    for part in parts:
        tip = part.end + part.radii[1] * part.axes[2]
        if all(heights(other, tip[None])[0] > 0 for other in parts if other is not part):
            assert np.linalg.norm(surface.vertices - tip, axis=-1).min() < 1.2 * part.radii[1]
            tips += 1
    assert tips >= 2


def test_vertices_are_at_the_zero_level_of_the_union(case):
    """It is outside all capsules, by at most s log P."""
    body, surface = case
    parts, soft = capsules(body)
    assert np.abs(CapsuleUnion(parts, soft).values(surface.vertices)).max() < 1e-6
    least = np.min([heights(part, surface.vertices) for part in parts], axis=0)
    assert least.min() > -1e-4
    assert least.max() < soft * np.log(len(parts)) / 0.85


def test_number_of_vertices_is_close_to_the_request(case):
    body, surface = case
    assert 695 <= len(surface.vertices) <= 700
    assert 195 <= len(rest_surface(body, 200).vertices) <= 200


def test_impossible_numbers_of_vertices_are_errors():
    for vertices in (100, 100_000):
        with pytest.raises(ValueError, match=f"vertices must be .*got {vertices}"):
            rest_surface(lopsided(), vertices)


def test_surfaces_of_symmetric_bodies_are_symmetric_in_all_bits(symmetric):
    body, surface = symmetric
    at = {tuple(vertex): index for index, vertex in enumerate((surface.vertices + 0.0).tolist())}
    assert len(at) == len(surface.vertices)
    mirror = np.array([at[tuple(vertex)] for vertex in (surface.vertices * FLIP + 0.0).tolist()])
    triangles = {frozenset(corners) for corners in surface.triangles.tolist()}
    assert {frozenset(corners) for corners in mirror[surface.triangles].tolist()} == triangles
    weights = weight_matrix(body, surface)
    order = list(body.skeleton.mirrored_order)
    np.testing.assert_allclose(weights[mirror][:, order], weights, atol=1e-3)


def test_weights_belong_to_the_nearest_bones(case):
    body, surface = case
    np.testing.assert_allclose(surface.weights.sum(axis=-1), 1, rtol=1e-12)
    assert (surface.weights >= 0).all()
    assert (surface.joints[surface.weights == 0] == 0).all()
    weights = weight_matrix(body, surface)
    parts, soft = capsules(body)
    above = np.stack([heights(part, surface.vertices) for part in parts], axis=-1)
    for at, part in enumerate(parts):
        if part.after < 0:
            continue
        bone = part.end - part.start
        along = (surface.vertices - part.start) @ bone / (bone @ bone)
        clear = above[:, at] + 2 * soft < np.delete(above, at, axis=1).min(axis=1)
        middle = clear & (np.abs(along - 0.5) < 0.2)
        assert (weights[middle].argmax(axis=1) == part.after).all()
        assert (weights[middle, part.after] > 0.7).all()


def test_parts_beyond_the_last_joints_move_with_the_bones_above(symmetric):
    body, surface = symmetric
    index, weights = body.skeleton.index, weight_matrix(body, surface)
    x, y, z = surface.vertices.T
    if "tail" in body.skeleton.joint_names:
        expected = {z.argmax(): ["head"], z.argmin(): ["tail"]}
        # Ribs do not turn with the neck.
        ribs = np.where(x == 0, y, 1.0).argmin()
        expected[ribs] = ["left_shoulder", "right_shoulder"]
        assert z.max() > body.rest_positions[:, 2].max() + 0.1  # the snout
    else:
        # The head turns with the shoulders.
        expected = {y.argmax(): ["left_shoulder", "right_shoulder"], x.argmax(): ["left_wrist"]}
    for vertex, joints in expected.items():
        values = weights[vertex, [index(joint) for joint in joints]]
        np.testing.assert_allclose(values, 1 / len(joints), atol=0.02)


def test_surfaces_do_not_depend_on_chance():
    first, again = surface_of("person")[1], rest_surface(BODIES["person"]())
    for name in ("vertices", "triangles", "joints", "weights"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("vertices", np.nan, "vertices must be finite"),
        ("triangles", 700, "triangles must be of vertices 0 to"),
        ("weights", -0.1, "weights must be at least 0 with sums 1"),
    ],
)
def test_other_surfaces_are_refused(name, value, words) -> None:
    surface = surface_of("lopsided")[1]
    changed = getattr(surface, name).copy()
    changed[3, 1] = value
    with pytest.raises(ValueError, match=words):
        replace(surface, **{name: changed})

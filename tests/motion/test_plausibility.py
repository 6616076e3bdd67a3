"""Sizes, standing axes and sides of bodies."""

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.synthetic.animals import synthetic_animals
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.data.synthetic.gaits import GAITS, make_gait
from probmotion.motion.plausibility import body_size, is_mirrored, stands_along

MIRROR = np.array([-1.0, 1.0, 1.0])


def test_the_size_is_that_of_the_largest_body_and_robust():
    skeleton = Skeleton([f"j{j}" for j in range(6)] + ["ball"], [-1, 0, 1, 2, 3, 4, -1])
    positions = np.zeros((9, 7, 3))
    positions[:, :6, 0] = np.arange(6)
    positions[:, 6, 1] = 100.0
    positions[:4, 5] = 1e6  # glitches
    assert body_size(positions, skeleton) == pytest.approx(5.0)
    assert body_size(positions[:, :4], Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 2])) is None


@pytest.mark.parametrize("style", [name for name in GAITS if "quadruped" not in name])
def test_synthetic_gaits(style):
    motion = make_gait(style, frames=30)
    X, skeleton = motion.positions, motion.skeleton
    assert 1.3 < body_size(X, skeleton) < 2.0
    assert stands_along(X, skeleton) == 1
    assert stands_along(np.roll(X, 1, axis=-1), skeleton) == 2
    assert stands_along(-X, skeleton) is None
    assert not is_mirrored(X, skeleton)
    assert not is_mirrored(X[::-1], skeleton)  # walks backwards
    assert not is_mirrored(motion.turned(2.0).positions, skeleton)
    assert not is_mirrored(np.roll(X, 1, axis=-1), skeleton)
    assert is_mirrored(X * MIRROR, skeleton)
    assert is_mirrored(X[:, list(skeleton.mirrored_order)], skeleton)


def test_pairs_and_quadrupeds():
    dance = synthetic_dances()[0]
    assert stands_along(dance.positions, dance.skeleton) == 1
    assert is_mirrored(dance.positions * MIRROR, dance.skeleton)
    assert not is_mirrored(dance.positions, dance.skeleton)
    animal = synthetic_animals()[0]
    for X in (animal.positions, animal.positions * MIRROR, np.roll(animal.positions, 1, axis=-1)):
        assert stands_along(X, animal.skeleton) is None
        assert not is_mirrored(X, animal.skeleton)
        assert 0.3 < body_size(X, animal.skeleton) < 3.0


def test_feet_show_where_a_body_with_straight_legs_faces():
    names = ["pelvis", "neck", *(f"{s}_{p}" for s in ("left", "right")
             for p in ("hip", "knee", "ankle", "toe"))]  # fmt: skip
    skeleton = Skeleton(names, [-1, 0, 0, 2, 3, 4, 0, 6, 7, 8])
    rest = np.zeros((10, 3))
    rest[0], rest[1] = [0, 1, 0], [0, 1.5, 0]
    for side, x in ((2, 0.1), (6, -0.1)):
        rest[side : side + 4] = [[x, 1, 0], [x, 0.5, 0], [x, 0, 0], [x, 0, 0.1]]
    assert not is_mirrored(rest[None], skeleton)
    assert is_mirrored(rest[None] * MIRROR, skeleton)
    unknown = skeleton.subset([j for j, name in enumerate(names) if "toe" not in name])
    without = rest[[names.index(name) for name in unknown.joint_names]]
    assert not is_mirrored(without[None] * MIRROR, unknown)

"""Skeletons and their presets."""

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.motion.presets import PRESETS


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], []), "joint_names must contain at least one joint, got none"),
        ((["hip", "a", "hip"], [-1, 0, 0]), r"joint_names must be unique, got \['hip'\]"),
        ((["hip", "knee"], [-1]), "parents must have one entry per joint, 2, got 1"),
        ((["hip", "knee"], [-1, 2]), r"parents\[1\] must be -1 or a joint's index below 2, got 2"),
        ((["hip", "knee"], [-2, 0]), r"parents\[0\] must be an integer of at least -1, got -2"),
        ((["hip", "knee"], [-1, 0.0]), r"parents\[1\] must be an integer of at least -1, got 0.0"),
        ((["hip", "knee"], [-1, 0], [0.1]), "radii must have one entry per joint, 2, got 1"),
        ((["hip"], [-1], [0.0]), r"radii\[0\] must be a finite number above 0, got 0.0"),
        ((["a", "b", "c", "d"], [-1, 2, 1, 1]), r"parents must form trees, got a cycle \(b → c\)"),
        ((["a"], [0]), r"got a cycle \(a\)"),
    ],
)
def test_invalid_skeletons_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Skeleton(*arguments)


def test_unknown_names_list_the_known_ones():
    with pytest.raises(ValueError, match=r"name must be one of .*coco17.*h36m17.*, got 'h36m'"):
        Skeleton.preset("h36m")
    with pytest.raises(ValueError, match=r"pelvis.*, got 'paw', which names no joint"):
        Skeleton.preset("h36m17").index("paw")
    with pytest.raises(ValueError, match="joints must be 0 to 16, got 17"):
        Skeleton.preset("h36m17").subset([17])


def test_index_accepts_own_and_canonical_names():
    skeleton = Skeleton.preset("cmu31")
    assert skeleton.index("lfemur") == skeleton.index("left_knee") == 4
    assert skeleton.canonical_names[skeleton.index("root")] == "pelvis"


def test_topology_with_parents_after_children():
    skeleton = Skeleton(["ankle", "knee", "hip", "ball"], [1, 2, -1, -1])
    assert skeleton.roots == (2, 3)
    assert skeleton.bones == ((0, 1), (1, 2))
    assert skeleton.topological_order == (2, 1, 0, 3)
    assert skeleton.ancestors(0) == (1, 2)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_presets_are_symmetric_trees_of_their_size(preset):
    skeleton = Skeleton.preset(preset)
    order = skeleton.topological_order
    assert sorted(order) == list(range(skeleton.n_joints))
    # Mirrored joints have mirrored parents.
    mirror = dict(skeleton.mirrored_pairs) | {b: a for a, b in skeleton.mirrored_pairs}
    assert len(mirror) == 2 * len(skeleton.mirrored_pairs)
    for joint, parent in skeleton.bones:
        assert order.index(parent) < order.index(joint)
        if joint in mirror:
            assert skeleton.parents[mirror[joint]] == mirror.get(parent, parent)
    sizes = {"pair17": 34, "gymnast-ball": 18, "body25": 25, "body25b": 25}
    assert skeleton.n_joints == sizes.get(preset, int(preset[-2:]) if preset[-1].isdigit() else 0)


def test_canonical_names_of_presets():
    def both(*parts):
        return {f"{side}_{part}" for side in ("left", "right") for part in parts}

    limbs = both("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    legs = both("eye", "shoulder", "elbow", "front_paw", "hip", "knee", "back_paw")
    mocap = {"pelvis", "spine", "chest", "neck", "head"} | limbs
    for preset, names in (
        ("h36m17", mocap - {"chest"} | {"nose"}),
        ("apt36k17", {"nose", "neck", "tail"} | legs),
        ("person17", mocap),
        ("pair17", {f"person{p}:{name}" for p in (0, 1) for name in mocap}),
    ):
        assert set(Skeleton.preset(preset).canonical_names) == names
    assert Skeleton.preset("gymnast-ball").joint_names[-1] == "ball"
    for preset in ("pair17", "gymnast-ball"):
        assert len(Skeleton.preset(preset).roots) == 2


def test_presets_agree_with_real_data(real_data):
    for preset, file in (
        ("cmu31", "cmu_single/cmu_01_01.npz"),
        ("body25b", "pose2sim_multiview/S00_P00_T01_BalancingTrial_cam_01.npz"),
    ):
        archive = np.load(real_data / file)
        real = Skeleton(archive["joint_names"].tolist(), archive["parents"].tolist())
        assert real.canonical_names == Skeleton.preset(preset).canonical_names
        assert real.parents == Skeleton.preset(preset).parents


def test_subset_bridges_missing_joints():
    chain = Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 2], [0.1, 0.2, 0.3, 0.4])
    part = chain.subset([3, 0, 2])
    assert part.joint_names == ("d", "a", "c")
    assert part.parents == (2, -1, 1)
    assert part.radii == (0.4, 0.1, 0.3)
    assert chain.subset([3, 1]).parents == (1, -1)


def test_equality_and_hash_ignore_radii():
    assert len({Skeleton.preset("coco17"), Skeleton.preset("coco17")}) == 1
    assert len({Skeleton(["a"], [-1], [0.1]), Skeleton(["a"], [-1])}) == 1
    assert Skeleton(["a", "b"], [-1, 0]) != Skeleton(["a", "b"], [-1, -1])

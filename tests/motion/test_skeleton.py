"""Skeletons: trees of named joints."""

from __future__ import annotations

import pytest

from probmotion import Skeleton
from probmotion.motion.presets import PRESETS


def test_a_cycle_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"parents form a cycle \(b → c\), expected a tree"):
        Skeleton(["a", "b", "c", "d"], [-1, 2, 1, 1])
    with pytest.raises(ValueError, match=r"cycle \(a\)"):
        Skeleton(["a"], [0])


def test_bad_input_is_refused_in_one_sentence() -> None:
    with pytest.raises(ValueError, match="joint_names must contain at least one joint, got none"):
        Skeleton([], [])
    with pytest.raises(ValueError, match=r"joint_names repeats \['hip'\], expected every name onc"):
        Skeleton(["hip", "knee", "hip"], [-1, 0, 0])
    with pytest.raises(ValueError, match="parents has 1 entries, expected 2, one per joint"):
        Skeleton(["hip", "knee"], [-1])
    with pytest.raises(ValueError, match=r"parents\[1\] \(knee\) is 2, expected -1 \(a root\)"):
        Skeleton(["hip", "knee"], [-1, 2])
    with pytest.raises(ValueError, match=r"parents\[0\] \(hip\) is -2"):
        Skeleton(["hip", "knee"], [-2, 0])
    with pytest.raises(ValueError, match="radii has 1 entries, expected 2"):
        Skeleton(["hip", "knee"], [-1, 0], [0.1])


def test_unknown_presets_and_joints_list_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"name must be one of .*coco17.*h36m17, got 'h36m'"):
        Skeleton.preset("h36m")
    walker = Skeleton.preset("h36m17")
    with pytest.raises(ValueError, match=r"'paw', which names no joint of this skeleton.*pelvis"):
        walker.index("paw")


def test_joints_are_found_by_own_and_canonical_names() -> None:
    skeleton = Skeleton.preset("cmu31")
    assert skeleton.index("lfemur") == skeleton.index("left_knee") == 4
    assert skeleton.canonical_names[skeleton.index("root")] == "pelvis"


def test_parents_may_come_after_their_children() -> None:
    skeleton = Skeleton(["ankle", "knee", "hip", "ball"], [1, 2, -1, -1])
    assert skeleton.roots == (2, 3)
    assert skeleton.bones == ((0, 1), (1, 2))
    assert skeleton.topological_order == (2, 1, 0, 3)
    assert skeleton.ancestors(0) == (1, 2)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_presets_are_trees_in_a_fixed_order(preset: str) -> None:
    skeleton = Skeleton.preset(preset)
    order = skeleton.topological_order
    assert sorted(order) == list(range(skeleton.n_joints))
    for joint, parent in skeleton.bones:
        assert order.index(parent) < order.index(joint)
    # Mirrored joints hang from mirrored parents.
    mirror = dict(skeleton.mirrored_pairs) | {b: a for a, b in skeleton.mirrored_pairs}
    assert len(mirror) == 2 * len(skeleton.mirrored_pairs)
    for joint, other in mirror.items():
        parent = skeleton.parents[joint]
        assert skeleton.parents[other] == mirror.get(parent, parent)
    digits = "".join(c for c in preset.replace("body25b", "25").replace("36", "") if c.isdigit())
    people = 2 if preset == "pair17" else 1
    expected = 18 if preset == "gymnast-ball" else people * int(digits)
    assert skeleton.n_joints == expected


def test_preset_joints_that_other_rooms_rely_on() -> None:
    sides = ("left", "right")
    person = {"pelvis", "spine", "neck", "nose", "head"} | {
        f"{side}_{part}"
        for side in sides
        for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    }
    assert set(Skeleton.preset("h36m17").canonical_names) == person
    quadruped = {"nose", "neck", "tail"} | {
        f"{side}_{part}"
        for side in sides
        for part in ("eye", "shoulder", "elbow", "front_paw", "hip", "knee", "back_paw")
    }
    assert set(Skeleton.preset("apt36k17").canonical_names) == quadruped
    pair = Skeleton.preset("pair17")
    assert len(pair.roots) == 2
    mocap = person - {"nose"} | {"chest"}
    assert {name.split(":")[1] for name in pair.canonical_names} == mocap
    assert set(Skeleton.preset("person17").canonical_names) == mocap
    assert Skeleton.preset("gymnast-ball").joint_names[-1] == "ball"
    assert len(Skeleton.preset("gymnast-ball").roots) == 2


def test_presets_are_those_of_the_real_data(real_data: object) -> None:
    import numpy as np

    for preset, file in (
        ("cmu31", "cmu_single/cmu_01_01.npz"),
        ("body25b", "pose2sim_multiview/S00_P00_T01_BalancingTrial_cam_01.npz"),
    ):
        archive = np.load(real_data / file)  # type: ignore[operator]
        found = Skeleton(archive["joint_names"].tolist(), archive["parents"].tolist())
        assert found.canonical_names == Skeleton.preset(preset).canonical_names
        assert found.parents == Skeleton.preset(preset).parents


def test_a_subset_bridges_the_joints_left_out() -> None:
    chain = Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 2], [0.1, 0.2, 0.3, 0.4])
    part = chain.subset([3, 0, 2])
    assert part.joint_names == ("d", "a", "c")
    assert part.parents == (2, -1, 1)
    assert part.radii == (0.4, 0.1, 0.3)
    assert chain.subset([3, 1]).parents == (1, -1)


def test_equal_skeletons_are_interchangeable() -> None:
    assert Skeleton.preset("coco17") == Skeleton.preset("coco17")
    assert len({Skeleton.preset("coco17"), Skeleton.preset("coco17")}) == 1
    assert Skeleton(["a"], [-1], [0.1]) == Skeleton(["a"], [-1])
    assert Skeleton(["a", "b"], [-1, 0]) != Skeleton(["a", "b"], [-1, -1])

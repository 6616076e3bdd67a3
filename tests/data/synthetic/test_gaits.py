"""Procedural gaits: constant bones, upright bodies, speeds and phases."""

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import GAITS, make_gait, make_gaits


@pytest.mark.parametrize("style", list(GAITS))
def test_bodies_are_rigid_and_upright_and_walk_forwards(style):
    clip = make_gait(style, 1, frames=60)
    positions, skeleton = clip.positions, clip.skeleton
    joint, parent = np.array(skeleton.bones).T
    lengths = np.linalg.norm(positions[:, joint] - positions[:, parent], axis=-1)
    assert (lengths > 0.02).all()
    np.testing.assert_allclose(lengths, lengths[[0]].repeat(60, axis=0), rtol=1e-9)
    root = positions[:, skeleton.roots[0]]
    assert -0.15 < positions[..., 1].min() < positions[..., 1].max() < 2.0
    # At the start the body moves and faces towards +Z.
    assert root[5, 2] > root[0, 2]
    assert positions[0, skeleton.index("nose"), 2] > root[0, 2]
    left, right = (positions[0, skeleton.index(f"{side}_hip"), 0] for side in ("left", "right"))
    assert left > right


def test_running_is_faster_than_walking():
    def speed(style):
        clips = [make_gait(style, number, frames=60) for number in range(20)]
        return np.mean([np.linalg.norm(c.positions[-1, 0] - c.positions[0, 0]) for c in clips])

    assert speed("run") > 2 * speed("walk")


def test_opposite_legs_swing_in_opposite_phase():
    clip = make_gait("walk", 0, frames=90)
    left, right = (
        clip.positions[:, clip.skeleton.index(f"{side}_ankle"), 2] - clip.positions[:, 0, 2]
        for side in ("left", "right")
    )
    assert np.corrcoef(left, right)[0, 1] < -0.8


def test_clip_does_not_depend_on_other_clips():
    clips = {clip.name: clip for clip in make_gaits(50, seed=3)}
    np.testing.assert_array_equal(clips["run-4"].positions, make_gait("run", 4, seed=3).positions)
    assert not np.array_equal(clips["run-4"].positions, make_gait("run", 4, seed=4).positions)


def test_default_style_frequencies():
    names = [clip.name.rpartition("-")[0] for clip in make_gaits(300)]
    assert [names.count(name) for name in ("walk", "run", "march")] == [150, 90, 60]


def test_invalid_styles():
    with pytest.raises(ValueError, match="style must be one of walk, run, march, "):
        make_gait("crawl")
    with pytest.raises(ValueError, match=r"styles\['walk'\] must be a finite number above 0"):
        make_gaits(10, styles={"walk": 0})

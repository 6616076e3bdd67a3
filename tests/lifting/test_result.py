import json
import re
from dataclasses import replace

import numpy as np
import pytest

from probmotion.io.files import load
from probmotion.lifting.keypoints import ANKLES, PERSON
from probmotion.motion.skeleton import Skeleton


def test_a_lift_is_saved(lifted, tmp_path):
    lifted.save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "lift.bvh", "lift.glb", "lift.html", "lift.npz", "lift.smpl22.npz", "summary.json",
    ]  # fmt: skip
    content = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert content["trusted"] == lifted.trusted
    with np.load(tmp_path / "lift.npz", allow_pickle=False) as archive:
        assert np.allclose(archive["draws"], lifted.draws)
        assert np.allclose(archive["sd"], lifted.sd)
    # Relative to their middle, the hips mirror each other.
    left, right = (PERSON.joint_names.index(f"{side}_hip") for side in ("left", "right"))
    assert np.allclose(lifted.sd[:, left], lifted.sd[:, right])
    assert lifted.sd[:, left].mean() < lifted.sd.mean()
    assert np.allclose(load(tmp_path / "lift.npz").positions, lifted.mean.positions)
    smpl = load(tmp_path / "lift.smpl22.npz")
    assert smpl.skeleton == Skeleton.preset("smpl22")
    assert smpl.rotations is not None
    moved = smpl.retarget(lifted.mean.skeleton).positions - lifted.mean.positions
    assert np.linalg.norm(moved, axis=-1).mean() < 0.015


def test_standing_feet_are_put_on_the_floor(lifted):
    still = np.repeat(lifted.mean.positions[:1], 60, axis=0)
    still[:, ANKLES, 1] = 0.095
    steps = 0.1 * np.arange(60)[:, None, None] * [1.0, 0.0, 0.0]  # 3 m/s
    up = np.array([0.0, 0.5, 0.0])
    for positions, lower in ((still, 0.02), (still + steps, 0.0), (still + up, 0.0)):
        given = replace(lifted, mean=replace(lifted.mean, positions=positions))
        moved = positions - given.on_floor.positions
        assert (moved[..., [0, 2]] == 0).all()
        np.testing.assert_allclose(moved[..., 1], lower, atol=5e-4)


def test_the_page_loads_nothing_and_escapes_names(lifted, tmp_path):
    named = replace(lifted, mean=replace(lifted.mean, name="<script>alert(1)</script>"))
    text = named.report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "default-src 'none'" in text
    assert lifted.summary()[1] in text
    (data,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    assert json.loads(data)["low"] == 0  # the floor, which no joint touches


def test_other_suffixes_are_refused(lifted, tmp_path):
    with pytest.raises(ValueError, match="end in"):
        lifted.report(tmp_path / "page.txt")

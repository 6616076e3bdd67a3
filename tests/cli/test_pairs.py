"""The command ``probmotion pairs``."""

import json

import numpy as np
import pytest

from probmotion.cli.main import main
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.io.files import load, save
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

NAMES = [
    "annotations.npz", "pairs.bvh", "pairs.glb", "pairs.html", "pairs.npz", "prior.npz",
]  # fmt: skip
PERSON = Skeleton.preset("person17")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write COCO results of two dancers, of one of them, and 3D seeds; return their folder."""
    path = tmp_path_factory.mktemp("dance")
    coco = Skeleton.preset("coco17")
    dance = synthetic_dances(1, frames=310, seed=5)[0]
    rng = np.random.default_rng(0)
    pixels = dance.positions[..., :2] * [200.0, -200.0] + 600.0
    pixels += 3.0 * rng.standard_normal(pixels.shape)
    results = []
    for frame, pair in enumerate(pixels):
        for person, points in enumerate(np.split(pair, 2)):
            values = []
            for name in coco.canonical_names:
                name = "head" if name == "nose" else name
                known = name in PERSON.joint_names
                x, y = points[PERSON.index(name)] if known else (0.0, 0.0)
                values += [x, y, 0.9 * known]
            results.append({"image_id": f"{frame}.jpg", "idx": person, "keypoints": values})
    for name, people in (("two", (0, 1)), ("one", (0,))):
        chosen = [each for each in results if each["idx"] in people]
        (path / f"{name}.json").write_text(json.dumps(chosen), encoding="utf-8")
    (path / "empty.json").write_text("[]", encoding="utf-8")
    seed = synthetic_dances(1, seed=11)[0].window(40, 1)
    save(seed, path / "seed.bvh")
    for number, positions in enumerate(np.split(seed.positions, 2, axis=1)):
        save(Motion(positions, PERSON, 30.0), path / f"person{number}.npz")
    return path


def test_a_video_and_a_seed_become_pairs(capsys, folder, tmp_path):
    words = ["pairs", str(folder / "two.json"), "--fps", "30", "--draws", "3"]
    people = [str(folder / f"person{number}.npz") for number in range(2)]
    bvh = str(folder / "seed.bvh")
    for name, seed in (("one", [bvh]), ("two", people), ("swapped", [bvh, "--swap-people"])):
        assert main([*words, "--seed", *seed, "--out", str(tmp_path / name)]) == 0
        assert "310 annotations" in capsys.readouterr().out
        assert sorted(path.name for path in (tmp_path / name).iterdir()) == NAMES
    one, two, swapped = (
        load(tmp_path / name / "pairs.npz").positions for name in ("one", "two", "swapped")
    )
    np.testing.assert_allclose(one, two, atol=1e-4)  # a BVH file is rounded
    assert np.abs(swapped[:, 17:, 0] - one[:, :17, 0]).mean() < 0.05
    assert f"{(tmp_path / 'one' / 'pairs.npz').as_posix()}" in (
        tmp_path / "one" / "pairs.html"
    ).read_text(encoding="utf-8")


def test_errors_are_one_line_and_leave_no_files(fails, folder, tmp_path):
    out = tmp_path / "out"
    seed = folder / "seed.bvh"
    cases = {
        ("one.json", "--seed", seed): "tracks must be of two people, got 1",
        ("empty.json", "--seed", seed): "expected",
        ("none.json", "--seed", seed): "must be an existing file",
        ("two.json", "--seed", folder / "person0.npz"): "must have 2 roots, one per person, got 1",
        ("two.json", "--seed", folder / "two.json"): "suffix must be .bvh, .npz or .amc",
        ("two.json", "--seed", seed, seed, seed): "--seed must be one or two files, got 3",
        ("two.json", "--seed", seed, "--draws", "1"): "draws must be",
    }
    for (name, *options), expected in cases.items():
        message = fails("pairs", folder / name, *options, "--fps", "30", "--out", out)
        assert expected in message, message
        assert not any(out.rglob("*.*"))
    assert "fps must be given" in fails("pairs", folder / "two.json", "--seed", seed, "--out", out)

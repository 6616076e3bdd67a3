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


def _landmarks(points):
    """Return landmarks of MediaPipe, relative to an image of 2000 by 1000 pixels."""
    result = []
    for name in Skeleton.preset("mediapipe33").canonical_names:
        name = "head" if name in ("nose", "left_ear", "right_ear") else name
        known = name in PERSON.joint_names
        x, y = points[PERSON.index(name)] / [2000, 1000] if known else (0.0, 0.0)
        result.append({"x": x, "y": y, "visibility": 0.9 * known})
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write keypoints of two dancers, of one of them, and with a spectator, and 3D seeds."""
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
    spectator = [{**each, "idx": 2} for each in results if each["idx"] == 0]
    for name, people in (("two", (0, 1)), ("one", (0,)), ("three", (0, 1, 2))):
        chosen = [each for each in [*spectator, *results] if each["idx"] in people]
        (path / f"{name}.json").write_text(json.dumps(chosen), encoding="utf-8")
    frames = [
        {"pose_landmarks": [_landmarks(points) for points in np.split(pair, 2)]} for pair in pixels
    ]
    (path / "media.json").write_text(json.dumps(frames), encoding="utf-8")
    (path / "empty.json").write_text("[]", encoding="utf-8")
    seed = synthetic_dances(1, seed=11)[0].window(40, 1)
    save(seed, path / "seed.bvh")
    for number, positions in enumerate(np.split(seed.positions, 2, axis=1)):
        save(Motion(positions, PERSON, 30.0), path / f"person{number}.npz")
    return path


def run(source, *options, seed, out):
    """Run the command on keypoints."""
    words = ["--fps", "30", "--draws", "3", "--seed", *map(str, seed), "--out", str(out)]
    assert main(["pairs", str(source), *options, *words]) == 0


@pytest.fixture(scope="module")
def lifted(folder, tmp_path_factory):
    """Return the two dancers, lifted, and the folder of the files."""
    out = tmp_path_factory.mktemp("lifted") / "one"
    run(folder / "two.json", seed=[folder / "seed.bvh"], out=out)
    return load(out / "pairs.npz"), out


def test_a_video_and_a_seed_become_pairs(capsys, folder, lifted, tmp_path):
    motion, out = lifted
    people = [folder / f"person{number}.npz" for number in range(2)]
    run(folder / "two.json", seed=people, out=tmp_path / "two")
    assert "from 52 of its 310 frames" in capsys.readouterr().out
    run(folder / "two.json", "--swap-people", seed=[folder / "seed.bvh"], out=tmp_path / "swapped")
    for path in (out, tmp_path / "two", tmp_path / "swapped"):
        assert sorted(file.name for file in path.iterdir()) == NAMES
    two, swapped = (load(tmp_path / name / "pairs.npz").positions for name in ("two", "swapped"))
    np.testing.assert_allclose(motion.positions, two, atol=1e-4)  # a BVH file is rounded
    assert np.abs(swapped[:, 17:, 0] - motion.positions[:, :17, 0]).mean() < 0.05
    assert motion.name == "two"


def test_people_are_chosen_and_landmarks_need_the_size_of_the_image(
    fails, folder, lifted, tmp_path
):
    two, seed, media = lifted[0].positions, [folder / "seed.bvh"], ["media.json", "--people", "2"]
    cases = {
        "three": ["three.json", "--persons", "1", "0", "--swap-people"],
        # People without ids are numbered from the left.
        "media": [*media, "--image-size", "2000", "1000", "--swap-people"],
    }
    for name, (file, *options) in cases.items():
        run(folder / file, *options, seed=seed, out=tmp_path / name)
    three, landmarks = (load(tmp_path / name / "pairs.npz").positions for name in cases)
    np.testing.assert_array_equal(three, two)
    assert np.abs(landmarks - two).mean() < 0.02
    words = ["--fps", "30", "--seed", *seed, "--out", tmp_path / "out"]
    assert "--image-size" in fails("pairs", folder / media[0], *media[1:], *words)


def test_errors_are_one_line_and_leave_no_files(fails, folder, tmp_path):
    out = tmp_path / "out"
    seed = folder / "seed.bvh"
    cases = {
        ("one.json", "--seed", seed): "tracks must be of two people, got 1",
        ("three.json", "--seed", seed): "got 3; of more, choose two (--persons I J)",
        ("three.json", "--seed", seed, "--persons", "1", "3"): "indices of 0 to 2, got 1 and 3",
        ("three.json", "--seed", seed, "--persons", "1", "1"): "indices of 0 to 2, got 1 and 1",
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

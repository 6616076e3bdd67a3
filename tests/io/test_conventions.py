"""Units, vertical axis and sides of motion files: checks and their repairs."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion, Skeleton, load, load_all
from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.bvh import read_bvh
from probmotion.io.bvh_writing import write_bvh
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.npz import read_npz
from probmotion.motion.kinematics import forward_kinematics

WALK = make_gait("walk", frames=40)
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
FILES = {
    "mm": (lambda X: 1000 * X, {"unit": "mm"}, r"0\.3 to 3 m large, got 1[5-9]\d\d; .*--unit mm"),
    "cm": (lambda X: 100 * X, {"unit": "cm"}, r"0\.3 to 3 m large, got 1[5-9]\d\.\d; .*--unit cm"),
    "z": (lambda X: X @ Z_UP.T, {"up": "z"}, "Y must be up, got bodies that stand.*--up z"),
    "left": (lambda X: X * [-1, 1, 1], {"mirror": True}, "left joints are on .*--mirror"),
}


def write(path, positions, **more):
    skeleton = WALK.skeleton
    np.savez(
        path, positions=positions, fps=30.0, joint_names=np.array(skeleton.joint_names),
        parents=np.array(skeleton.parents), **more,
    )  # fmt: skip
    return path


@pytest.mark.parametrize("kind", list(FILES))
def test_wrong_conventions_are_reported_and_can_be_fixed(tmp_path, kind, capsys):
    change, repair, message = FILES[kind]
    path = write(tmp_path / "walk.npz", change(WALK.positions))
    if kind == "left":
        with pytest.warns(MotionFileWarning, match=message):
            load(path)
    else:
        with pytest.raises(MotionFileError, match=message) as caught:
            load(path)
        assert "\n" not in str(caught.value)
    np.testing.assert_allclose(load(path, **repair).positions, WALK.positions, atol=1e-12)
    (motion,) = load_all([path], **repair)
    np.testing.assert_allclose(motion.positions, WALK.positions, atol=1e-12)
    name, value = next(iter(repair.items()))
    flags = [f"--{name}", *([value] if isinstance(value, str) else [])]
    assert main(["convert", str(path), str(tmp_path / "out.npz"), *flags]) == 0
    np.testing.assert_allclose(load(tmp_path / "out.npz").positions, WALK.positions, atol=1e-12)
    assert main(["show", str(path), *flags]) == 0
    assert "height 0." in capsys.readouterr().out


def test_declared_and_given_conventions_are_trusted(tmp_path):
    path = write(tmp_path / "walk.npz", WALK.positions @ Z_UP.T, up_axis="z")
    np.testing.assert_allclose(load(path).positions, WALK.positions, atol=1e-12)
    path = write(tmp_path / "lying.npz", WALK.positions @ Z_UP.T)
    np.testing.assert_array_equal(load(path, up="y").positions, WALK.positions @ Z_UP.T)
    path = write(tmp_path / "mouse.npz", 0.05 * WALK.positions)
    np.testing.assert_array_equal(load(path, unit="m").positions, 0.05 * WALK.positions)


def test_rotations_are_converted(tmp_path):
    rng = np.random.default_rng(0)
    offsets = rng.standard_normal((4, 3))
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 0])
    rotations = np.linalg.qr(rng.standard_normal((5, 4, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[..., None, None]
    root = rng.standard_normal((5, 1, 3))
    motion = Motion(
        forward_kinematics(skeleton, rotations, root, offsets)[0], skeleton, 30.0, rotations,
        offsets,
    )  # fmt: skip
    write_bvh(motion, tmp_path / "a.bvh")
    plain = read_bvh(tmp_path / "a.bvh", scale=1.0)
    for options, scale, turn in (
        ({"unit": "m", "up": "z"}, 1.0, Z_UP.T),
        ({"unit": "in", "mirror": True}, 0.0254, np.diag([-1.0, 1.0, 1.0])),
    ):
        found = load(tmp_path / "a.bvh", **options)
        np.testing.assert_allclose(found.positions, scale * plain.positions @ turn.T, atol=1e-9)
        again, _ = forward_kinematics(
            skeleton, found.rotations, found.positions[:, :1], found.rest_offsets
        )
        np.testing.assert_allclose(again, found.positions, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unit": "km"}, "unit must be one of m, cm, mm, in, got 'km'"),
        ({"up": "x"}, "up must be one of y, z, got 'x'"),
    ],
)
def test_unknown_conventions_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        load("walk.npz", **options)
    with pytest.raises(ValueError, match=r"unit must be None for walk\.amc"):
        load("walk.amc", unit="mm")


def test_real_clips_raise_no_false_alarm(real_data):
    files = [*real_data.glob("[cd]*_*/*.npz"), *real_data.glob("originals/*.[ba][vm][hc]")]
    assert len(files) > 100
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for file in files:
            load(file)
    assert not [one for one in caught if "left joints" in str(one.message)]


def test_real_clips_with_z_up_are_refused(real_data, tmp_path):
    walks = sorted((real_data / "cmu_actions").glob("walk*_1*.npz"))
    assert walks
    for file in walks:
        motion = read_npz(file)
        joints, parents = np.array(motion.skeleton.joint_names), np.array(motion.skeleton.parents)
        path = Path(tmp_path / file.name)
        np.savez(
            path, positions=motion.positions @ Z_UP.T, fps=30.0, joint_names=joints,
            parents=parents,
        )  # fmt: skip
        with pytest.raises(MotionFileError, match="--up z"):
            load(path)

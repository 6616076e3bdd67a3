"""Tables of joint positions: TRC and CSV."""

import csv

import numpy as np
import pytest

from probmotion import Motion, Skeleton, read_joints, save
from probmotion.data.synthetic.gaits import make_gait

PERSON = Skeleton.preset("person14")


@pytest.fixture(scope="module")
def walk():
    return make_gait("walk", frames=12, fps=29.97).retarget(PERSON)


def test_trc_files_are_read_back(walk, tmp_path):
    positions = walk.positions.copy()
    positions[3, 0] = 0.0  # read as a gap if it were written exactly
    save(Motion(positions, PERSON, walk.fps), tmp_path / "walk.trc")
    track = read_joints(tmp_path / "walk.trc")
    assert (track.skeleton, track.fps) == (PERSON, walk.fps)
    np.testing.assert_allclose(track.joints, positions, atol=1.1e-6)


def test_csv_columns_are_named(walk, tmp_path):
    names = ["a,b", *PERSON.joint_names[1:]]
    save(Motion(walk.positions, Skeleton(names, PERSON.parents), 50), tmp_path / "walk.csv")
    with open(tmp_path / "walk.csv", encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:5] == ["frame", "time", "a,b_x", "a,b_y", "a,b_z"]
    table = np.array(rows, dtype=float)
    np.testing.assert_allclose(table[:, 0], np.arange(12))
    np.testing.assert_allclose(table[:, 1], np.arange(12) / 50)
    np.testing.assert_allclose(table[:, 2:].reshape(12, 14, 3), walk.positions, atol=5.1e-7)


@pytest.mark.parametrize("name", ["a\tb", " ", "a\n"])
def test_names_that_break_trc_files_are_refused(tmp_path, name):
    with pytest.raises(ValueError, match="joint_names must not be empty or contain tabs"):
        save(Motion(np.zeros((1, 1, 3)), Skeleton([name], [-1]), 30), tmp_path / "clip.trc")
    assert not list(tmp_path.iterdir())

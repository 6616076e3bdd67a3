"""CMU clips by name: archives and original files contain the same motion."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from probmotion.data.cmu_clips import cmu_clip
from probmotion.io.errors import MotionFileError
from probmotion.io.files import save
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

ASF = """:units
length 0.254
angle deg
:root
order TX TY TZ RX RY RZ
:bonedata
begin
name head
direction 0 1 0
length 5
axis 0 0 0 XYZ
end
:hierarchy
begin
root head
end
"""


def write_originals(folder, frames):
    """Write a subject who moves by 1 m per frame."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "02.asf").write_text(ASF)
    lines = [f"{number}\nroot {10 * number} 0 0 0 0 0\n" for number in range(frames)]
    (folder / "02_02.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n" + "".join(lines))


def write_archive(folder, frames, fps=30.0):
    folder.mkdir(parents=True, exist_ok=True)
    skeleton = Skeleton(["root", "head"], [-1, 0])
    save(Motion(np.zeros((frames, 2, 3)), skeleton, fps, name="other"), folder / "cmu_02_02.npz")


def test_originals_are_subsampled_and_cut_after_thirty_seconds(tmp_path):
    write_originals(tmp_path, frames=10)
    clip = cmu_clip("cmu_02_02", tmp_path)
    assert (clip.name, clip.fps, clip.frames) == ("cmu_02_02", 30.0, 3)
    np.testing.assert_array_equal(clip.positions[:, 0, 0], [0.0, 4.0, 8.0])
    np.testing.assert_allclose(clip.positions[:, 1, 1], 0.5)
    for frames, expected in ((3601, 900), (3596, 899)):
        write_originals(tmp_path, frames)
        assert cmu_clip("cmu_02_02", tmp_path).frames == expected
    write_archive(tmp_path, 901)
    assert cmu_clip("cmu_02_02", tmp_path).frames == 900


def test_folders_are_searched_in_order(no_data):
    frames = 0
    for location in ("shared/data", "cache"):
        for write, folder in (
            (write_originals, "."),
            (write_originals, "cmu-01-02-03"),
            (write_archive, "."),
            (write_archive, "cmu_single"),
        ):
            frames += 1
            write(no_data / location / folder, 4 * frames if write is write_originals else frames)
            clip = cmu_clip("cmu_02_02")
            assert (clip.name, clip.frames) == ("cmu_02_02", frames)
    write_originals(Path("mine"), frames=9)
    assert cmu_clip("cmu_02_02", "mine").frames == 3
    Path("mine/02.asf").unlink()
    with pytest.raises(FileNotFoundError, match="clip cmu_02_02 is not in mine; "):
        cmu_clip("cmu_02_02", "mine")


def test_missing_clip_names_folders_and_remedy(no_data):
    download = r'download\("cmu-01-02-03", names=\["02.asf", "02_02.amc"\]\) downloads it, or pass'
    for name, remedy in (
        ("cmu_02_02", download),
        ("cmu_131_02", "pass the folder with its"),
    ):
        with pytest.raises(FileNotFoundError, match=remedy) as error:
            cmu_clip(name)
        text = str(error.value)
        assert text.endswith("variable PROBMOTION_DATA")
        assert text.count(str(no_data / "cache")) == text.count("../shared/data") == 1
        assert ("download" in text) == (name == "cmu_02_02")


def test_invalid_names_and_archives(tmp_path):
    for name in ("02_02", "cmu_2_2", "cmu_02_02.npz", "../cmu_02_02", "", 3):
        with pytest.raises(ValueError, match="name must be a subject and a trial, such as"):
            cmu_clip(name)
    write_archive(tmp_path, 9, fps=120.0)
    with pytest.raises(MotionFileError, match=r"02\.npz must have 30 frames per second, got 120"):
        cmu_clip("cmu_02_02", tmp_path)


def test_archives_and_originals_are_identical(real_data, tmp_path):
    for name in ("02.asf", "02_01.amc"):
        shutil.copy(real_data / "originals" / name, tmp_path / name)
    archived, original = cmu_clip("cmu_02_01", real_data), cmu_clip("cmu_02_01", tmp_path)
    for name in ("skeleton", "name", "fps"):
        assert getattr(archived, name) == getattr(original, name)
    np.testing.assert_array_equal(archived.positions, original.positions)

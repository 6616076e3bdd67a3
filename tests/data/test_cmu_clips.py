"""CMU clips by name: archives and original files give the same motion."""

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


def put_originals(folder, frames=9, name="02_02"):
    """Write a subject who moves by 1 m per frame."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name[:-3]}.asf").write_text(ASF)
    lines = [f"{number}\nroot {10 * number} 0 0 0 0 0\n" for number in range(frames)]
    (folder / f"{name}.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n" + "".join(lines))


def put_archive(folder, frames, fps=30.0, name="cmu_02_02"):
    folder.mkdir(parents=True, exist_ok=True)
    skeleton = Skeleton(["root", "head"], [-1, 0])
    save(Motion(np.zeros((frames, 2, 3)), skeleton, fps, name="other"), folder / f"{name}.npz")


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A working folder without shared data beside it, and an empty cache."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path / "cache"))
    return tmp_path


def test_originals_are_subsampled(tmp_path):
    put_originals(tmp_path, frames=10)
    clip = cmu_clip("cmu_02_02", tmp_path)
    assert (clip.name, clip.fps, clip.frames) == ("cmu_02_02", 30.0, 3)
    np.testing.assert_array_equal(clip.positions[:, 0, 0], [0.0, 4.0, 8.0])
    np.testing.assert_allclose(clip.positions[:, 1, 1], 0.5)


def test_clips_are_cut_after_thirty_seconds(tmp_path):
    for frames, expected in ((3597, 900), (3601, 900), (3596, 899)):
        put_originals(tmp_path, frames)
        assert cmu_clip("cmu_02_02", tmp_path).frames == expected
    put_archive(tmp_path, 901)
    assert cmu_clip("cmu_02_02", tmp_path).frames == 900


@pytest.mark.parametrize("folder", ["cache", "cache/cmu_single", "shared/data/cmu_single"])
def test_archives_are_found(nowhere, folder):
    put_archive(nowhere / folder, frames=7)
    clip = cmu_clip("cmu_02_02")
    assert (clip.name, clip.frames) == ("cmu_02_02", 7)
    with pytest.raises(FileNotFoundError):
        cmu_clip("cmu_02_03")


@pytest.mark.parametrize("folder", ["cache", "cache/cmu-01-02-03", "shared/data/cmu-01-02-03"])
def test_originals_need_motion_and_skeleton(nowhere, folder):
    put_originals(nowhere / folder)
    assert cmu_clip("cmu_02_02").frames == 3
    (nowhere / folder / "02.asf").unlink()
    with pytest.raises(FileNotFoundError, match=r"clip cmu_02_02 is not in .*cache"):
        cmu_clip("cmu_02_02")


def test_folders_are_searched_in_order(nowhere):
    put_archive(nowhere / "shared" / "data" / "cmu_single", frames=4)
    assert cmu_clip("cmu_02_02").frames == 4
    put_originals(nowhere / "cache" / "cmu-01-02-03", frames=17)
    assert cmu_clip("cmu_02_02").frames == 5
    put_archive(nowhere / "cache", frames=6)
    assert cmu_clip("cmu_02_02").frames == 6
    with pytest.raises(FileNotFoundError, match="clip cmu_02_02 is not in mine; "):
        cmu_clip("cmu_02_02", "mine")
    put_archive(Path("mine"), frames=7)
    assert cmu_clip("cmu_02_02", "mine").frames == 7


def test_missing_clip_names_folders_and_remedy(nowhere):
    expected = r'download\("cmu-01-02-03", names=\["02.asf", "02_02.amc"\]\) fetches it, or pass'
    with pytest.raises(FileNotFoundError, match=expected) as error:
        cmu_clip("cmu_02_02")
    assert "\n" not in str(error.value)
    for place in (nowhere / "cache", Path("../shared/data")):
        assert str(place) in str(error.value)
    assert str(error.value).count(str(nowhere / "cache")) == 1
    with pytest.raises(FileNotFoundError, match="pass the folder with its archive") as error:
        cmu_clip("cmu_131_02")
    assert "download" not in str(error.value)
    for name in ("cmu_02_02", "cmu_131_02"):
        with pytest.raises(FileNotFoundError, match=r"variable PROBMOTION_DATA$"):
            cmu_clip(name)


@pytest.mark.parametrize("name", ["02_02", "cmu_2_2", "cmu_02_02.npz", "../cmu_02_02", "", 3])
def test_malformed_names_are_rejected(name):
    with pytest.raises(ValueError, match="name must be a subject and a trial, such as"):
        cmu_clip(name)


def test_archive_of_another_frame_rate_is_rejected(tmp_path):
    put_archive(tmp_path, 9, fps=120.0)
    with pytest.raises(MotionFileError, match=r"02\.npz must have 30 frames per second, got 120"):
        cmu_clip("cmu_02_02", tmp_path)


def test_archives_and_originals_are_identical(real_data, tmp_path):
    for name in ("02.asf", "02_01.amc"):
        shutil.copy(real_data / "originals" / name, tmp_path / name)
    archived, original = cmu_clip("cmu_02_01", real_data), cmu_clip("cmu_02_01", tmp_path)
    assert archived.skeleton == original.skeleton
    assert archived.name == original.name
    assert archived.fps == original.fps
    np.testing.assert_array_equal(archived.positions, original.positions)

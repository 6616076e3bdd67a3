"""Single clips by name: from archives or the database's own files, the same numbers."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probmotion.data.cmu_clips import cmu_clip
from probmotion.io.errors import MotionFileError
from probmotion.io.files import save_motion
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


def put_originals(folder: Path, frames: int = 9, name: str = "02_02") -> None:
    """Write a subject who goes 1 m further in each frame."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name[:-3]}.asf").write_text(ASF)
    lines = [f"{number}\nroot {10 * number} 0 0 0 0 0\n" for number in range(frames)]
    (folder / f"{name}.amc").write_text(":FULLY-SPECIFIED\n:DEGREES\n" + "".join(lines))


def put_archive(folder: Path, frames: int, fps: float = 30.0, name: str = "cmu_02_02") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    skeleton = Skeleton(["root", "head"], [-1, 0])
    save_motion(
        Motion(np.zeros((frames, 2, 3)), skeleton, fps, name="other"), folder / f"{name}.npz"
    )


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder without shared data beside it, and an empty cache."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path / "cache"))
    return tmp_path


def test_every_fourth_frame_of_an_original_is_taken(tmp_path: Path) -> None:
    put_originals(tmp_path, frames=10)
    clip = cmu_clip("cmu_02_02", tmp_path)
    assert (clip.name, clip.fps, clip.frames) == ("cmu_02_02", 30.0, 3)
    np.testing.assert_array_equal(clip.positions[:, 0, 0], [0.0, 4.0, 8.0])
    np.testing.assert_allclose(clip.positions[:, 1, 1], 0.5)


def test_clips_end_after_thirty_seconds(tmp_path: Path) -> None:
    for frames, wanted in ((3597, 900), (3601, 900), (3596, 899)):
        put_originals(tmp_path, frames)
        assert cmu_clip("cmu_02_02", tmp_path).frames == wanted
    put_archive(tmp_path, 901)
    assert cmu_clip("cmu_02_02", tmp_path).frames == 900


@pytest.mark.parametrize("place", ["cache", "cache/cmu_single", "shared/data/cmu_single"])
def test_archives_are_found_where_they_are(nowhere: Path, place: str) -> None:
    put_archive(nowhere / ("shared/data" if "shared" in place else "cache"), 3, name="cmu_02_03")
    with pytest.raises(FileNotFoundError):
        cmu_clip("cmu_02_02")
    put_archive(nowhere / place, frames=7)
    clip = cmu_clip("cmu_02_02")
    assert (clip.name, clip.frames) == ("cmu_02_02", 7)


@pytest.mark.parametrize("place", ["cache", "cache/cmu-01-02-03", "shared/data/cmu-01-02-03"])
def test_originals_are_found_where_they_are(nowhere: Path, place: str) -> None:
    put_originals(nowhere / place)
    (nowhere / place / "02.asf").rename(nowhere / "02.asf")
    # A motion without its skeleton is none.
    with pytest.raises(FileNotFoundError, match=r"the clip cmu_02_02 is not in .*cache"):
        cmu_clip("cmu_02_02")
    (nowhere / "02.asf").rename(nowhere / place / "02.asf")
    assert cmu_clip("cmu_02_02").frames == 3


def test_the_first_place_wins_and_a_folder_that_is_given_is_the_only_one(nowhere: Path) -> None:
    put_archive(nowhere / "shared" / "data" / "cmu_single", frames=4)
    assert cmu_clip("cmu_02_02").frames == 4
    put_originals(nowhere / "cache" / "cmu-01-02-03", frames=17)
    assert cmu_clip("cmu_02_02").frames == 5
    put_archive(nowhere / "cache", frames=6)
    assert cmu_clip("cmu_02_02").frames == 6
    with pytest.raises(FileNotFoundError, match="the clip cmu_02_02 is not in mine; "):
        cmu_clip("cmu_02_02", "mine")
    put_archive(Path("mine"), frames=7)
    assert cmu_clip("cmu_02_02", "mine").frames == 7


def test_a_clip_that_is_nowhere_is_one_sentence_with_the_way_to_it(nowhere: Path) -> None:
    wanted = r'download\("cmu-01-02-03", names=\["02.asf", "02_02.amc"\]\) fetches it, or give'
    with pytest.raises(FileNotFoundError, match=wanted) as error:
        cmu_clip("cmu_02_02")
    assert "\n" not in str(error.value)
    for place in (nowhere / "cache", Path("../shared/data")):
        assert str(place) in str(error.value)
    assert str(error.value).count(str(nowhere / "cache")) == 1
    with pytest.raises(FileNotFoundError, match="give the folder that holds its archive") as error:
        cmu_clip("cmu_131_02")
    assert "download" not in str(error.value)
    for name in ("cmu_02_02", "cmu_131_02"):
        with pytest.raises(FileNotFoundError, match=r"variable PROBMOTION_DATA$"):
            cmu_clip(name)


@pytest.mark.parametrize("name", ["02_02", "cmu_2_2", "cmu_02_02.npz", "../cmu_02_02", ""])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"name must be a subject and a trial, such as, got '.*'"):
        cmu_clip(name)


def test_a_name_is_text() -> None:
    number: Any = 3
    with pytest.raises(ValueError, match=r"^name must be a subject and a trial, such as, got 3"):
        cmu_clip(number)


def test_an_archive_of_another_rate_is_refused(tmp_path: Path) -> None:
    put_archive(tmp_path, 9, fps=120.0)
    with pytest.raises(MotionFileError, match=r"cmu_02_02\.npz has 120 frames per second, expect"):
        cmu_clip("cmu_02_02", tmp_path)


def test_archives_and_originals_are_the_same_to_the_last_bit(
    real_data: Path, tmp_path: Path
) -> None:
    for name in ("02.asf", "02_01.amc"):
        shutil.copy(real_data / "originals" / name, tmp_path / name)
    archived, original = cmu_clip("cmu_02_01", real_data), cmu_clip("cmu_02_01", tmp_path)
    assert archived.skeleton == original.skeleton
    assert archived.name == original.name
    assert archived.fps == original.fps
    np.testing.assert_array_equal(archived.positions, original.positions)


def test_the_held_out_walk_is_found_and_fits_the_body(real_data: Path) -> None:
    clip = cmu_clip("cmu_02_02", real_data)
    assert (clip.frames, clip.skeleton.n_joints) == (75, 31)
    body = clip.retarget(Skeleton.preset("person14"))
    height = np.ptp(body.positions[..., 1], axis=1).mean()
    assert 1.2 < height < 2.0

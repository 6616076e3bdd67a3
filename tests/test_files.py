import os
import re

import pytest

from probmotion.files import check_writable, written_together


def test_checking_a_folder_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_writable(tmp_path / "new" / "out")
    check_writable(tmp_path / "new" / ".." / "out")
    assert not any(tmp_path.iterdir())
    kept = tmp_path / "kept"
    kept.mkdir()
    check_writable(kept)
    assert kept.is_dir()
    with pytest.raises(OSError, match=r"out must be a writable folder, got .*: File name too long"):
        check_writable(tmp_path / "made" / ("long" * 100))
    assert list(tmp_path.iterdir()) == [kept]


def test_files_are_written_together_or_not_at_all(tmp_path):
    out = tmp_path / "new" / "out"

    def interrupted():
        with written_together(out) as unfinished:
            (unfinished / "first.txt").write_text("1", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not any(tmp_path.iterdir())
    out.mkdir(parents=True)
    (out / "first.txt").write_text("0", encoding="utf-8")
    (out / "other.txt").write_text("0", encoding="utf-8")
    with written_together(out) as unfinished:
        for name in ("first.txt", "second.txt"):
            (unfinished / name).write_text("1", encoding="utf-8")
        assert (out / "first.txt").read_text(encoding="utf-8") == "0"
    assert {path.name: path.read_text(encoding="utf-8") for path in out.iterdir()} == {
        "first.txt": "1",
        "other.txt": "0",
        "second.txt": "1",
    }


def test_errors_of_files_written_together_name_the_folder(tmp_path):
    def clash():
        with written_together(tmp_path) as unfinished:
            (unfinished / "file").write_text("1", encoding="utf-8")
            (unfinished / "missing" / "file").write_text("1", encoding="utf-8")

    message = f"cannot write {tmp_path}: No such file or directory; choose a writable folder"
    with pytest.raises(OSError, match=f"^{re.escape(message)}$"):
        clash()
    assert not any(tmp_path.iterdir())


def test_folders_of_killed_writers_are_removed(tmp_path):
    with written_together(tmp_path) as unfinished:
        left = unfinished.name.replace(f".{os.getpid()}.", f".{2**22 + 1}.")
    (tmp_path / left).mkdir()
    (tmp_path / left / "file").write_text("1", encoding="utf-8")
    check_writable(tmp_path)
    assert not any(tmp_path.iterdir())

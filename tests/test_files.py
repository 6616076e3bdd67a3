import pytest

from probmotion.files import check_writable


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

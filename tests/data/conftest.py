"""Fixtures of the tests of clips and downloads."""

import pytest


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A working folder without shared data beside it, and an empty cache."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path / "cache"))
    return tmp_path

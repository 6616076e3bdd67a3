"""Fixtures of the tests of clips and downloads."""

import pytest


@pytest.fixture
def no_data(tmp_path, monkeypatch):
    """Return the parent of a working folder without shared data, with an empty cache."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path / "cache"))
    return tmp_path

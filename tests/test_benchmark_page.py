"""Page of benchmarks: rows of the scripts that ran, and of those that ran before."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "page.py"


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Return the function that runs scripts in a folder and returns its status and the rows."""
    spec = importlib.util.spec_from_file_location("page", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    listed = {"a.py": {"speed": "at least 3"}, "b.py --fast": {"memory": ""}}
    page = tmp_path / "benchmarks.md"
    for name, value in {"FOLDER": tmp_path, "PAGE": page, "BENCHMARKS": listed}.items():
        monkeypatch.setattr(module, name, value)

    def run(*scripts, **code):
        for name, text in code.items():
            (tmp_path / f"{name}.py").write_text(f"import sys\n{text}\n", encoding="utf-8")
        monkeypatch.setattr(sys, "argv", ["page.py", *scripts])
        status = module.main()
        lines = page.read_text(encoding="utf-8").splitlines()
        return status, [line for line in lines if line.startswith("| `")]

    return run


FIRST = {"a": "print('speed: 4')", "b": "print('memory:', len(sys.argv))"}
SECOND = {"a": "print('speed: 5')", "b": "print('memory: 7')"}


def test_rows_of_other_scripts_are_kept(write):
    status, rows = write(**FIRST)
    assert status == 0
    assert [row.split(" | ")[:4] for row in rows] == [
        ["| `speed`", "4", "at least 3", "`python benchmarks/a.py`"],
        ["| `memory`", "2", "", "`python benchmarks/b.py --fast`"],
    ]
    assert write("b.py", **SECOND) == (0, [rows[0], rows[1].replace("| 2 |", "| 7 |")])


@pytest.mark.parametrize("fault", ["print('other: 4')", "print('speed: 5'); sys.exit(3)"])
def test_a_script_that_fails_has_no_new_row(write, fault, capsys):
    _, rows = write(**FIRST)
    assert write(**SECOND | {"a": fault}) == (1, [rows[0], rows[1].replace("| 2 |", "| 7 |")])
    assert "a.py failed" in capsys.readouterr().err

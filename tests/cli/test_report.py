"""The command ``probmotion report``, and subsets run into one folder."""

import shutil

import pandas as pd
import pytest

from probmotion.cli.main import main


def run(words, out):
    return main(["compare", *words.split(), "--workers", "0", "--out", str(out)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two subsets run into one folder; do not change it."""
    out = tmp_path_factory.mktemp("out")
    assert run("gait-sparse --samplers exact --draws 12", out) == 0
    words = "gait --samplers mas --draws 12 --settings.mas.steps 3"
    assert run(words, out) == 0
    return out


def test_the_report_shows_the_union_also_of_an_unfinished_comparison(folder, tmp_path, capsys):
    table = pd.read_csv(folder / "table.csv")
    assert set(zip(table["problem"], table["sampler"], strict=True)) == {
        ("gait-sparse", "exact"),
        ("gait", "mas"),
    }
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "table.csv").unlink()
    shutil.rmtree(copy / "runs" / "gait-sparse" / "exact" / "0")
    for words, page in (
        ([folder, "--out", tmp_path / "again.html"], tmp_path / "again.html"),
        ([copy], copy / "report.html"),
    ):
        assert main(["report", *map(str, words)]) == 0
        assert capsys.readouterr().out == f"report: {page}\n"
        written = page.read_text()
        for name in ("gait-sparse", "exact", "mas"):
            assert name in written


def test_incompatible_subsets_are_refused(folder, tmp_path, capsys):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert run("gait-sparse --samplers mh --draws 20", folder) == 2
    assert capsys.readouterr().err == (
        f"probmotion: out must be a new folder, got {folder}, which contains finished runs with "
        "draws 12 instead of 20\n"
    )
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before

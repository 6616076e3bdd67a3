"""README and documentation: examples run, links resolve, tables have at most six columns."""

from __future__ import annotations

import doctest
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest

from probmotion.citations import CITATIONS, OF_SETTINGS, POSE_PAIRS
from probmotion.cli.main import main
from probmotion.comparison.results.table import BLOCKS

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SITE = "https://probmotion.readthedocs.io/en/latest/"
REPOSITORY = "https://github.com/probmotion/probmotion/"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
WITH_EXAMPLES = [page for page in PAGES if "```pycon" in page.read_text(encoding="utf-8")]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", WITH_EXAMPLES, ids=name_of)
def test_examples_run_as_printed(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = doctest.testfile(str(page), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert result.attempted > 3
    assert result.failed == 0


def test_readme_is_short():
    assert len(README.splitlines()) <= 150


def test_readme_links_are_absolute_and_resolve():
    targets = re.findall(r"\]\(([^)]+)\)", README)
    assert len(targets) > 10
    for target in targets:
        assert target.startswith((SITE, REPOSITORY)), target
        if target.startswith(SITE):
            source = ROOT / "docs" / target.removeprefix(SITE).removesuffix(".html")
            generated = ("tutorials/", "reference/", "command-line")
            assert source.with_suffix(".md").exists() or any(part in target for part in generated)
        else:
            path = re.sub(r"^(raw|blob)/main/", "", target.removeprefix(REPOSITORY))
            assert (ROOT / path).exists(), target


def test_every_metric_of_the_table_is_defined():
    page = (ROOT / "docs" / "concepts" / "metrics.md").read_text(encoding="utf-8")
    endings = ("_side", "_learnt", "_visible_mm", "_occluded_mm", "_evaluations")
    for metric in {name for columns in BLOCKS.values() for name in columns}:
        assert f"`{metric}`" in page or metric.endswith(endings), metric


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_tables_have_at_most_six_columns(page):
    for line in page.read_text(encoding="utf-8").splitlines():
        if re.match(r"^\|[-|: ]+\|$", line):
            assert line.count("|") - 1 <= 6, line


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for target in set(re.findall(r"make (\w+)", README + contributing)):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_the_demo_lifts_the_shipped_keypoints(tmp_path):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (words,) = re.findall(r"probmotion (lift .*) --out demo/lift$", makefile, flags=re.MULTILINE)
    command, file, *options = words.split()
    assert main([command, str(ROOT / file), *options, "--draws", "4", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["trusted"]


def test_every_cited_work_is_listed():
    text = " ".join((ROOT / "docs" / "citing.md").read_text(encoding="utf-8").split())
    for works in [*CITATIONS.values(), *OF_SETTINGS.values(), POSE_PAIRS]:
        for work in works:
            assert work in text


def test_stored_tables_are_up_to_date():
    """The advice tables equal the output of the script for the stored measurements."""
    sys.path.insert(0, str(ROOT / "notebooks"))
    try:
        import which_sampler
    finally:
        sys.path.pop(0)
    stored = which_sampler.measured().rows["problem"].unique()
    advices = {name: which_sampler.advise(name) for name in stored}
    table = "\n".join(which_sampler.advice_table(advices))
    for page in which_sampler.PAGES:
        assert table in page.read_text(encoding="utf-8")
    longer = "\n".join(which_sampler.longer_table(which_sampler.measured().longer))
    assert longer in (ROOT / "docs" / "which-sampler.md").read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="one block called 'weather', got 0"):
        which_sampler.replace_block(README, "weather", "x")


@pytest.mark.parametrize(
    "script", sorted((ROOT / "notebooks").glob("[0-9]*.py")), ids=lambda path: path.stem
)
def test_executed_notebooks_match_their_scripts(script):
    executed = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    assert [cell.source for cell in executed.cells] == [
        cell.source for cell in jupytext.read(script).cells
    ]
    assert any(cell.get("outputs") for cell in executed.cells)


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_no_file_contains_paths_of_the_build_machine():
    done = subprocess.run(
        ["git", "grep", "-nIE", "/wo" + "rk/|/ho" + "me/|/ro" + "ot/", "--", "."],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode > 1:
        pytest.skip("not a git checkout")
    assert done.stdout == ""

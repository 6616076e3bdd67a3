"""What the README shows is true: its code runs, its paths exist, its commands work."""

from __future__ import annotations

import doctest
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from probmotion import Comparison
from probmotion.cli.main import main
from probmotion.comparison import QUICK_BUDGET
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.io.files import save_motion
from probmotion.posteriors.sampling import sampler_names

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ROOMS = ("probmotion", "samplers", "models")


def blocks(language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


def layout() -> tuple[set[Path], list[str]]:
    """Return the paths that the floor plan names, and its lines."""
    (plan,) = [block for block in blocks("text") if block.startswith("probmotion/")]
    named, room = set(), ROOT
    for line in plan.splitlines():
        words = re.findall(r"[\w.]+(?:\.py|/)(?![\w*])", line)
        if line[0] != " ":
            room = ROOT / words[0]
            named.add(room)
            words = words[1:] if line.startswith(ROOMS) and room.name != "probmotion" else []
        named |= {room / word for word in words}
    return named, plan.splitlines()


def test_the_doctests_pass():
    found = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert found.attempted > 5
    assert found.failed == 0


def test_the_library_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("walks").mkdir()
    for clip in make_gaits(60, frames=32):
        save_motion(clip, f"walks/{clip.name}.bvh")
    (code,) = blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    # As printed, but for the number of draws, seeds and steps.
    smaller = {
        "draws=200": "draws=12",
        "seeds=3": "seeds=1",
        "n_views=5": "n_views=5, steps=20",
        "MultiViewAncestral(),": "MultiViewAncestral(steps=20),",
    }
    for printed, run in smaller.items():
        assert printed in code
        code = code.replace(printed, run)
    exec(code, {})
    printed = capsys.readouterr().out
    for name in ("exact", "mas", "nuts", "swd_ratio"):
        assert name in printed
    assert Path("take3.bvh").exists()


def test_every_path_of_the_layout_exists_and_none_is_missing():
    named, _ = layout()
    assert [path for path in named if not path.exists()] == []
    there = {
        path
        for room in ROOMS
        for path in (ROOT / room).iterdir()
        if (path.suffix == ".py" or path.is_dir()) and path.name[:2] != "__"
    }
    # The samplers' common parts are named together.
    shared = {path for path in there if path.parent.name == "samplers"} - named
    assert there - named - shared == set()
    for name in sampler_names():
        from probmotion.posteriors.sampling import load_sampler

        module = load_sampler(name).__module__.rpartition(".")[2]
        assert ROOT / "samplers" / f"{module}.py" in named


def test_links_lead_somewhere():
    targets = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(targets) >= 4
    for target in targets:
        assert "://" in target or (ROOT / target).exists()


def test_the_make_targets_are_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"make (\w+)", README)):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_the_published_table_is_the_demonstration_of_every_sampler():
    block = re.search(r"<!-- demo table:.*?-->\n```text\n(.*?)```", README, flags=re.DOTALL)
    assert block is not None
    assert f"every sampler had {QUICK_BUDGET} per cell" in block[1]
    for problem in ("gait:", "gait-monocular:"):
        assert problem in block[1]
    for name in sampler_names():
        assert len(re.findall(rf"^{name} +", block[1], flags=re.MULTILINE)) >= 2


def test_every_cited_work_is_listed():
    from probmotion.citations import CITATIONS, OF_SETTINGS, POSE_PAIRS

    words = " ".join(README.split())
    for works in [*CITATIONS.values(), *OF_SETTINGS.values(), POSE_PAIRS]:
        for work in works:
            assert work in words


COMMANDS = re.findall(r"^    (probmotion compare --clips .*)$", README, flags=re.MULTILINE)


# A file's unit is inferred, with a warning; the command line prints it as a note.
@pytest.mark.filterwarnings("default")
@pytest.mark.skipif(not (ROOT / "../shared/data").exists(), reason="needs ../shared/data")
@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_on_real_clips_run(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    # The shell's work: what a pattern stands for.
    words = shlex.split(command)[1:]
    expanded = [str(path) for word in words for path in _expand(word)]
    assert main([*expanded, "--samplers", "exact", "--draws", "12", "--out", str(tmp_path)]) == 0
    assert "against the truth, mm" in capsys.readouterr().out
    table = Comparison.load(tmp_path).table()
    assert {"swd_ratio", "mpjpe_mm"} <= set(table["metric"])


def _expand(word: str) -> list[str]:
    return sorted(str(p) for p in ROOT.glob(word)) if "*" in word else [word]


def test_readme_figures_script_replaces_its_blocks():
    sys.path.insert(0, str(ROOT / "notebooks"))
    try:
        from readme_figures import replace_block
    finally:
        sys.path.pop(0)
    changed = replace_block(README, "demo table", "new")
    assert re.search(r"-->\nnew\n<!-- end of demo table", changed)
    assert replace_block(changed, "advice", "x") != changed
    with pytest.raises(ValueError, match="0 blocks"):
        replace_block(README, "weather", "x")


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_nothing_names_the_machine_that_it_was_made_on():
    done = subprocess.run(
        ["git", "grep", "-nIE", "/wo" + "rk/|/ho" + "me/|/ro" + "ot/", "--", "."],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode > 1:
        pytest.skip("not a git checkout")
    assert done.stdout == ""

"""The command line: what it prints and writes, and what it says of wrong input."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probmotion import Motion, MotionDraws, Skeleton
from probmotion.cli.main import main
from probmotion.cli.settings_options import object_from_text, text_of_object
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import load_motion, save_motion

PROGRAM = [sys.executable, "-c", "import sys; from probmotion.cli import main; sys.exit(main())"]
ONE_THREAD = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def walks(folder: Path, n: int = 5, frames: int = 40) -> list[str]:
    """Write n walks as BVH and npz in turn; return their paths."""
    paths = []
    for number in range(n):
        path = folder / f"walk{number}.{'npz' if number % 2 else 'bvh'}"
        save_motion(make_gait("walk", number, frames=frames), path)
        paths.append(str(path))
    return paths


def said(capsys) -> str:
    """Return the last sentence on standard error."""
    return capsys.readouterr().err.strip().splitlines()[-1]


# Help and start-up.


def test_help_takes_less_than_a_second():
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*PROGRAM, "--help"], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Of the processor's time, which a busy machine does not lengthen.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.0
    assert done.returncode == 0
    for command in ("compare", "list", "show", "convert"):
        assert f"\n  {command} " in done.stdout


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from probmotion.cli import main; main(['--help']); main(['show', 'no.bvh']);"
        "sys.exit(any(m in sys.modules for m in ('torch', 'jax', 'matplotlib.pyplot')))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


@pytest.mark.parametrize("command", ["compare", "list", "show", "convert"])
def test_every_command_explains_every_option(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    help_text = capsys.readouterr().out
    assert f"usage: probmotion {command}" in help_text
    if command == "compare":
        for option in ("--clips", "--prior", "--observe", "--workers", "--settings.mas.n-views"):
            assert option in help_text


def test_list_names_everything(capsys):
    assert main(["list"]) == 0
    listed = capsys.readouterr().out
    samplers = "exact ancestral3d mas mvpc sds mh nuts ensemble"
    for name in (*samplers.split(), "gait", "gait-monocular", "mas.reference_code", "h36m17"):
        assert f"\n  {name} " in listed


@pytest.mark.parametrize(("words", "lines"), [("compare --help", 1), ("which gait", 0)])
def test_a_reader_that_stops_early_is_no_error(words, lines):
    """While it is written to, and as the last lines leave a buffer that held all of them."""
    program = f"{sys.executable} -c '{PROGRAM[2]}' {words}"
    code = f"unset PYTHONUNBUFFERED; {program} | head -n {lines}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""


# Comparing.


def test_compare_writes_the_table(tmp_path, capsys):
    words = "compare gait --samplers exact mas --draws 20 --seeds 2 --settings.mas.steps 5"
    assert main([*words.split(), "--settings.mas.n-views", "3", "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "table.csv")
    assert list(table.columns) == ["problem", "sampler", "seed", "metric", "value"]
    assert set(table["sampler"]) == {"exact", "mas"}
    assert set(table["seed"]) == {0, 1}
    assert {"swd_ratio", "seconds"} <= set(table["metric"])
    printed = capsys.readouterr().out
    assert "exact" in printed
    assert "swd_ratio" in printed
    # 20 draws of 3 views in 5 steps: the settings arrived.
    calls = table[(table["sampler"] == "mas") & (table["metric"] == "denoiser_evaluations")]
    assert set(calls["value"]) == {20 * 3 * 5}


def test_compare_draws_pictures(tmp_path):
    words = "compare gait-monocular --samplers exact --draws 12 --pictures --workers 0 --out"
    assert main([*words.split(), str(tmp_path)]) == 0
    for name in ("quality_against_cost.png", "skeletons_gait-monocular.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_a_problem_without_exact_draws_has_pictures_too(tmp_path):
    words = "compare walk2d --samplers mas --draws 12 --settings.mas.steps 2 --pictures"
    assert main([*words.split(), "--workers", "0", "--out", str(tmp_path)]) == 0
    for name in ("quality_against_cost.png", "skeletons_walk2d.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_the_table_is_printed_before_pictures_are_drawn(tmp_path, capsys, monkeypatch):
    def fail(*_):
        raise ValueError("no picture today")

    monkeypatch.setattr("probmotion.comparison.figures.draw_comparison", fail)
    words = "compare gait --samplers exact --draws 12 --pictures --workers 0 --out"
    assert main([*words.split(), str(tmp_path)]) == 2
    printed = capsys.readouterr()
    assert "no picture today" in printed.err
    assert "seconds" in printed.out


@pytest.mark.parametrize("named", ["mine", "mine/model.safetensors"])
def test_a_prior_of_one_s_own_is_drawn_from(named, tmp_path, capsys):
    from probmotion.models.training.checkpoints import WEIGHTS

    (tmp_path / "mine").mkdir()
    shutil.copy(WEIGHTS / "walk2d.safetensors", tmp_path / "mine" / "model.safetensors")
    words = "compare --samplers mas mh --draws 12 --settings.mas.steps 2 --workers 0 --pictures"
    out = tmp_path / "out"
    assert main([*words.split(), "--prior", str(tmp_path / named), "--out", str(out)]) == 0
    table = pd.read_csv(out / "table.csv")
    assert set(table["problem"]) == {"mine"}
    drawn = table[table["sampler"] == "mas"]
    assert {"seconds", "denoiser_evaluations"} <= set(drawn["metric"])
    assert list(table[table["sampler"] == "mh"]["metric"]) == ["unsupported"]
    assert MotionDraws.load(out / "cells" / "mine" / "mas" / "0" / "draws.nc").fps == 20
    # Nothing measures quality, so that there is no plot of it.
    assert {file.name for file in out.glob("*.png")} == {"skeletons_mine.png"}


def test_a_preset_runs_beside_its_sampler(tmp_path):
    words = "compare gait --samplers mas mas.reference_code --draws 10 --settings.mas.steps 2"
    assert main([*words.split(), "--workers", "0", "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "table.csv")
    assert set(table["sampler"]) == {"mas", "mas.reference_code"}


def test_own_clips_of_two_formats_make_a_problem(tmp_path):
    walks(tmp_path, 6)
    words = "--held-out walk2 --samplers exact --draws 12 --rank 2 --styles 1 --workers 0 --out"
    pattern = str(tmp_path / "walk*")
    assert main(["compare", "--clips", pattern, *words.split(), str(tmp_path / "out")]) == 0
    table = pd.read_csv(tmp_path / "out" / "table.csv")
    assert {"swd_ratio", "mpjpe_mm"} <= set(table["metric"])


# Showing and converting.


def test_show_tells_what_a_motion_is(tmp_path, capsys):
    (path,) = walks(tmp_path, 1)
    picture = tmp_path / "walk.png"
    assert main(["show", path, "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "40 frames at 30 fps, 1.30 s" in printed
    assert "17 joints below pelvis" in printed
    assert picture.exists()


def test_show_finds_a_network_by_its_folder_or_name(tmp_path, capsys, monkeypatch):
    from probmotion.models.training.checkpoints import WEIGHTS

    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    shutil.copy(WEIGHTS / "walk2d.safetensors", "mine/model.safetensors")
    for given, file in {
        "mine": Path("mine/model.safetensors"),
        "walk2d": WEIGHTS / "walk2d.safetensors",
    }.items():
        assert main(["show", given]) == 0
        printed = capsys.readouterr().out
        assert printed.startswith(f"{file}: a motion-diffusion of ")
        assert "14 joints below pelvis" in printed
    assert main(["show", "walk3d"]) == 2
    assert said(capsys) == "probmotion: there is no file walk3d"


def test_show_reads_the_tables_of_deeplabcut(tmp_path, capsys):
    path = tmp_path / "mouse.csv"
    path.write_text(
        "scorer,net,net,net,net,net,net\nbodyparts,nose,nose,nose,tail,tail,tail\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,1,2,0.5,3,4,1\n1,2,3,0.5,,,0\n"
    )
    assert main(["show", str(path), "--fps", "10"]) == 0
    printed = capsys.readouterr().out
    assert f"{path}: 1 keypoint track\n" in printed
    assert "2 frames at 10 fps, 0.10 s\n  75% seen\n  2 joints below nose, tail" in printed
    assert main(["show", str(path)]) == 2
    assert "fps is missing" in said(capsys)


def test_show_and_convert_read_draws(tmp_path, capsys):
    words = "compare gait --samplers exact --draws 12 --workers 0 --out"
    assert main([*words.split(), str(tmp_path)]) == 0
    (path,) = tmp_path.rglob("draws.nc")
    assert main(["show", str(path)]) == 0
    assert "4 x 3 (chains x draws)" in capsys.readouterr().out
    take = tmp_path / "take.bvh"
    assert main(["convert", str(path), str(take), "--draw", "2"]) == 0
    wanted = MotionDraws.load(path).motion(2).positions
    np.testing.assert_allclose(load_motion(take).positions, wanted, atol=1e-4)


def test_convert_resamples_and_retargets(tmp_path):
    (path,) = walks(tmp_path, 1)
    target = tmp_path / "walk.npz"
    assert main(["convert", path, str(target), "--fps", "15", "--skeleton", "h36m17"]) == 0
    motion = load_motion(target)
    assert motion.fps == 15
    assert motion.skeleton.joint_names == Skeleton.preset("h36m17").joint_names
    assert motion.frames == 20


# Wrong input: one sentence, status 2.


def write(path: Path, content: str) -> str:
    path.write_text(content)
    return str(path)


def truncated(folder: Path) -> str:
    (path,) = walks(folder, 1)
    whole = Path(path).read_text()
    return write(folder / "half.bvh", whole[: int(0.7 * len(whole))])


def one_frame(folder: Path) -> str:
    skeleton = Skeleton.preset("h36m17")
    path = folder / "still.npz"
    save_motion(Motion(np.zeros((1, 17, 3)) + np.arange(17)[:, None], skeleton, 30), path)
    return str(path)


def test_calibration_within_a_budget_goes_on(tmp_path, capsys):
    words = ["compare", "gait-sparse(frames=4, components=6)", "walk2d", "--samplers", "mh"]
    words += ["--draws", "20", "--evaluations", "9000", "--calibrate", "10", "--workers", "0"]
    words += ["--out", str(tmp_path)]
    for _ in range(2):
        assert main(words) == 0
        told = capsys.readouterr().out
    assert "in 10 simulations" in told
    assert "walk2d cannot be simulated: it is not calibrated" in told
    cells = list((tmp_path / "calibration/cells").rglob("cell.json"))
    assert len(cells) == 10
    held = json.loads(cells[0].read_text())
    assert held["budget"]["used"] <= 9000
    assert held["budget"]["settings"]["thin"] >= 1


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("compare gait --samplers mcmc", ("'mcmc'", "exact", "nuts")),
        ("compare gait --samplers exact mh exact", ("samplers is exact mh exact", "each once")),
        ("compare gait --samplers mas.best", ("'mas.best'", "mas.reference_code")),
        ("compare jump", ("'jump'", "gait-monocular")),
        ("compare", ("no problem is given", "--clips", "--prior")),
        ("compare gait --draws 3", ("draws is 3",)),
        ("compare gait --calibrate 5", ("calibrate is 5", "10 simulations or more")),
        ("compare dance-pairs --calibrate 20", ("none of the problems can be simulated",)),
        ("compare gait --chains 0", ("chains is 0",)),
        ("compare gait --observe sparse", ("observe is given without clips", "--clips")),
        ("compare --prior no/such", ("no/such", "the folder of a training run")),
        ("compare --clips no/such/*.bvh", ("no/such/*.bvh", "no file")),
        ("compare --clips no/such.bvh", ("no/such.bvh",)),
        ("show no/such.bvh", ("no/such.bvh",)),
        ("convert no/such.bvh out.npz", ("no/such.bvh",)),
        ("draw", ("'draw'", "compare, which, list, show, convert")),
    ],
)
def test_wrong_words_get_one_sentence(words, expected, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 1
    for part in expected:
        assert part in errors[0]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda folder: write(folder / "shopping.bvh", "eggs\nmilk\n"), "shopping.bvh"),
        (lambda folder: write(folder / "zip.npz", "PK\x03\x04"), "no npz archive"),
        (lambda folder: write(folder / "notes.txt", "eggs"), "expected a motion in .bvh or .npz"),
        (truncated, "half.bvh"),
        (lambda folder: write(folder / "empty.bvh", ""), "empty.bvh"),
    ],
)
@pytest.mark.parametrize("command", ["show", "compare --out out --clips", "convert"])
def test_files_that_are_no_motion(make, expected, command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [*command.split(), make(tmp_path)] + (["out.npz"] if command == "convert" else [])
    assert main(words) == 2
    assert expected in said(capsys)


def test_clips_too_short_to_learn_from(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["compare", "--clips", one_frame(tmp_path), *walks(tmp_path, 2, frames=8)]) == 2
    assert "frames" in said(capsys)


def test_a_wrong_option_ends_with_status_2(capsys):
    with pytest.raises(SystemExit) as end:
        main(["compare", "gait", "--settings.mas.n-views", "1"])
    assert end.value.code == 2
    assert "n_views is 1, expected an integer of at least 2" in capsys.readouterr().err


@pytest.mark.parametrize("out", ["taken", "locked/out", "/proc/no-folder-can-be-made-here"])
def test_a_folder_that_cannot_be_written_to(out, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("a file stands here")
    Path("locked").mkdir(mode=0o500)
    if out == "locked/out" and os.geteuid() == 0:
        pytest.skip("root can write into a read-only folder")
    assert main(["compare", "gait", "--samplers", "exact", "--draws", "12", "--out", out]) == 2
    sentence = said(capsys)
    assert out in sentence
    assert "Traceback" not in sentence


def test_a_quick_look_is_of_few_draws_in_few_seconds_unless_told_otherwise(tmp_path, capsys):
    words = ["compare", "gait", "--samplers", "exact", "--quick", "--workers", "0"]
    assert main([*words, "--out", str(tmp_path / "a")]) == 0
    assert "every sampler had 6 seconds per cell" in capsys.readouterr().out
    assert json.loads((tmp_path / "a" / "comparison.json").read_text())["draws"] == 40
    more = ["--draws", "12", "--evaluations", "100", "--out", str(tmp_path / "b")]
    assert main([*words, *more]) == 0
    assert "every sampler had 100 evaluations" in capsys.readouterr().out
    assert json.loads((tmp_path / "b" / "comparison.json").read_text())["draws"] == 12


def test_all_problems_are_those_whose_data_is_at_hand(tmp_path, capsys, monkeypatch):
    at_hand = (["gait", "gait-sparse"], {"cmu": "no clips here"})
    monkeypatch.setattr("probmotion.problems.problems_at_hand", lambda: at_hand)
    words = ["--samplers", "exact", "--draws", "12", "--workers", "0", "--out", str(tmp_path)]
    assert main(["compare", "all", *words]) == 0
    assert "left out: cmu: no clips here" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "table.csv")
    assert set(table["problem"]) == {"gait", "gait-sparse"}
    assert main(["compare", "all", "gait", *words]) == 2
    assert "problems is all gait, expected all, or some names" in said(capsys)


# Ctrl-C.


@pytest.mark.parametrize("workers", ["0", "2"])
def test_an_interrupted_comparison_keeps_what_is_finished(workers, tmp_path):
    words = ["compare", "gait", "--samplers", "exact", "mas", "--draws", "40"]
    words = [*words, "--out", str(tmp_path)]
    long = ["--settings.mas.steps", "1000000", "--workers", workers]
    running = subprocess.Popen(
        [*PROGRAM, *words, *long], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=ONE_THREAD, start_new_session=True,
    )  # fmt: skip
    kept = tmp_path / "cells" / "gait" / "exact" / "0"
    deadline = time.monotonic() + 60
    while not kept.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert kept.exists()
    # As a terminal does: to the whole group of processes.
    os.killpg(running.pid, signal.SIGINT)
    _, errors = running.communicate(timeout=30)
    assert running.returncode == 130
    assert "Traceback" not in errors
    sentence = errors.strip().splitlines()[-1]
    assert "1 of 2 cells finished" in sentence
    assert str(tmp_path) in sentence

    before = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
    assert main([*words, "--settings.mas.steps", "3"]) == 0
    assert {path: path.stat().st_mtime_ns for path in kept.iterdir()} == before
    table = pd.read_csv(tmp_path / "table.csv")
    assert set(table["sampler"]) == {"exact", "mas"}


# Settings that are objects.


@dataclass(frozen=True)
class Plain:
    kind: str = field(default="plain", init=False)


@dataclass(frozen=True)
class Step:
    size: float = 0.5
    inner: Plain | None = None


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("Plain", Plain()),
        ("Step(size=2)", Step(2)),
        ("Step(0.25, inner=Plain())", Step(0.25, Plain())),
        (" Step( inner = Plain ) ", Step(inner=Plain())),
    ],
)
def test_objects_are_written_as_in_python(text, value):
    read = object_from_text(text, [Plain, Step])
    assert read == value
    assert object_from_text(text_of_object(read), [Plain, Step]) == value


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Leap", "'Leap' must be one of Plain, Step, got unknown"),
        ("Step(length=1)", "no setting 'length', expected one of size, inner"),
        ("Plain(kind='x')", "no setting 'kind'"),
        ("Step(", "is not an object"),
        ("Step(size=__import__('os'))", "unknown"),
        ("3", "is not an object"),
        ("Step(size=open)", "unknown"),
    ],
)
def test_what_is_no_object_is_refused(text, expected):
    with pytest.raises(ValueError, match=expected.replace("(", r"\(")):
        object_from_text(text, [Plain, Step])

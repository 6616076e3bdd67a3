"""The command line: output, files and error messages."""

import json
import re
import resource
import shutil
import subprocess
import sys
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import probmotion
from probmotion import MotionDraws, Skeleton
from probmotion.cli.main import _parse, main
from probmotion.cli.settings_options import object_from_text, sampler_called, text_of_object
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import load, save
from probmotion.models.training.checkpoints import WEIGHTS
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.posteriors.sampling import importable_samplers

PNG = b"\x89PNG"


def compare(out, words):
    """Run compare in this process and return its table."""
    assert main(["compare", *words.split(), "--workers", "0", "--out", str(out)]) == 0
    return pd.read_csv(out / "table.csv")


def test_help_is_fast_and_loads_nothing_heavy():
    code = (
        "import sys; from probmotion.cli.main import main; main(['--help']); main(['show', 'no']);"
        "sys.exit(any(m in sys.modules for m in ('torch', 'jax', 'matplotlib.pyplot')))"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # CPU time, which does not depend on the load of the machine.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.0
    assert run.returncode == 0
    for command in ("compare", "report", "which", "list", "show", "convert", "train", "reference"):
        assert f"\n  {command} " in run.stdout


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"probmotion {probmotion.__version__}\n"


COMMANDS = ["compare", "report", "list", "show", "convert", "denoise", "reference", "which"]


@pytest.mark.parametrize("command", COMMANDS)
def test_command_help(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    help_text = capsys.readouterr().out
    assert f"usage: probmotion {command}" in help_text
    assert not re.search(r"``|:[a-z]+:`", help_text)
    if command == "compare":
        lines = help_text.splitlines()
        assert len(lines) <= 80
        assert max(map(len, lines)) <= 100
        assert "--settings.mas" not in help_text
        for words in ("--clips", "--prior", "--observe", "--workers", "probmotion show SAMPLER"):
            assert words in help_text


def test_every_setting_of_every_sampler_is_shown_and_accepted(capsys):
    """Shown defaults are the defaults: passing them changes no sampler."""
    words = []
    for name, kind in importable_samplers().items():
        assert main(["show", name]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].startswith(f"{name}: ")
        shown = {}
        for line, meaning in pairwise(lines):
            if match := re.fullmatch(r"  (\S+) = (.+)  \((.+)\)", line):
                assert meaning.strip(), f"{name}: {line}"
                shown[match[1]] = match[2], match[3]
        assert shown.keys() == {f.name.replace("_", "-") for f in fields(kind) if f.init}
        for setting, (value, allowed) in shown.items():
            if allowed == f"{setting} or no-{setting}":
                words.append(f"--settings.{name}.{'' if value == 'True' else 'no-'}{setting}")
            elif "in Python only" not in allowed:
                words += [f"--settings.{name}.{setting}", value]
    command = _parse("compare", ["gait", *words])
    for name, kind in importable_samplers().items():
        assert sampler_called(name, command.settings) == kind()


def test_show_describes_presets_and_problems(capsys, tmp_path, monkeypatch):
    assert main(["show", "mas.reference_code"]) == 0
    shown = capsys.readouterr().out
    assert "\n  n-views = 7  (int)\n" in shown
    assert "--settings" not in shown
    assert main(["show", "gait-monocular(frames=20)"]) == 0
    shown = capsys.readouterr().out
    assert "20 frames at 30 fps, 17 joints" in shown
    assert re.search("samplers: .*exact.*nuts", shown)
    # A file precedes a sampler of its name.
    monkeypatch.chdir(tmp_path)
    Path("mas").mkdir()
    shutil.copy(WEIGHTS / "walk2d.safetensors", "mas/model.safetensors")
    assert main(["show", "mas"]) == 0
    assert "a motion-diffusion" in capsys.readouterr().out


def test_list_prints_problems_samplers_presets_and_skeletons(capsys):
    assert main(["list"]) == 0
    listed = capsys.readouterr().out
    samplers = "exact ancestral3d mas mvpc sds mh nuts ensemble tempered smc"
    for name in (*samplers.split(), "gait", "gait-monocular", "mas.reference_code", "h36m17"):
        assert f"\n  {name} " in listed


@pytest.mark.parametrize(("words", "lines"), [("compare --help", 1), ("which gait", 0)])
def test_closed_pipe_is_no_error(words, lines):
    """The pipe closes while it is written to, or when the buffer is flushed at the end."""
    script = "import sys; from probmotion.cli.main import main; sys.exit(main())"
    code = f"{sys.executable} -c '{script}' {words} | head -n {lines}; exit ${{PIPESTATUS[0]}}"
    command = ["bash", "-c", f"unset PYTHONUNBUFFERED; {code}"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


def test_compare_writes_the_table_and_passes_settings_to_presets_and_samplers(tmp_path, capsys):
    words = "gait --samplers exact mas mas.reference_code --draws 20 --seeds 2"
    table = compare(tmp_path, words + " --settings.mas.steps 5 --settings.mas.n-views 3")
    assert set(table["sampler"]) == {"exact", "mas", "mas.reference_code"}
    assert set(table["seed"]) == {0, 1}
    assert {"swd_ratio", "seconds"} <= set(table["metric"])
    assert "exact" in capsys.readouterr().out
    calls = table[(table["sampler"] == "mas") & (table["metric"] == "denoiser_evaluations")]
    assert set(calls["value"]) == {20 * 3 * 5}


def test_the_summary_is_printed_before_figures_fail(tmp_path, capsys, monkeypatch):
    failing = Mock(side_effect=ValueError("invalid figure"))
    monkeypatch.setattr("probmotion.comparison.figures.draw_comparison", failing)
    words = f"compare gait --samplers exact --draws 12 --figures --workers 0 --out {tmp_path}"
    assert main(words.split()) == 2
    printed = capsys.readouterr()
    assert "invalid figure" in printed.err
    assert f"metrics: {tmp_path / 'table.txt'}, " in printed.out


def test_compare_samples_a_user_prior(tmp_path):
    (tmp_path / "mine").mkdir()
    shutil.copy(WEIGHTS / "walk2d.safetensors", tmp_path / "mine" / "model.safetensors")
    words = "--samplers mas mh --draws 12 --settings.mas.steps 2 --figures --prior "
    out = tmp_path / "out"
    table = compare(out, words + str(tmp_path / "mine" / "model.safetensors"))
    assert set(table["problem"]) == {"mine"}
    assert "denoiser_evaluations" in set(table[table["sampler"] == "mas"]["metric"])
    assert list(table[table["sampler"] == "mh"]["metric"]) == ["unsupported"]
    assert MotionDraws.load(out / "runs" / "mine" / "mas" / "0" / "draws.nc").fps == 20
    # Without a measure of quality there is no plot of it.
    assert {file.name for file in out.glob("*.png")} == {"skeletons_mine.png"}


def test_compare_fits_a_prior_to_user_clips_of_two_formats(tmp_path, write_walks):
    write_walks(tmp_path, 6)
    for number in (0, 2, 4):
        save(load(tmp_path / f"walk{number}.npz"), tmp_path / f"walk{number}.bvh")
        (tmp_path / f"walk{number}.npz").unlink()
    words = "--held-out walk2 --samplers exact --draws 12 --rank 2 --styles 1 --clips "
    table = compare(tmp_path / "out", words + str(tmp_path / "walk*"))
    assert {"swd_ratio", "mpjpe_mm"} <= set(table["metric"])


@pytest.mark.parametrize(
    ("more", "budget", "draws"),
    [("", "6 seconds per", 200), (" --draws 12 --evaluations 100", "100 evaluations", 12)],
)
def test_quick_run_and_overrides(more, budget, draws, tmp_path, capsys):
    compare(tmp_path, "gait --samplers exact --quick" + more)
    assert budget in capsys.readouterr().out
    assert json.loads((tmp_path / "comparison.json").read_text())["draws"] == draws


def test_all_runs_the_problems_with_available_data(tmp_path, capsys, monkeypatch, fails):
    available = (["gait", "gait-sparse"], {"cmu": "no clips here"})
    monkeypatch.setattr("probmotion.problems.catalogue.available_problems", lambda: available)
    table = compare(tmp_path, "all --samplers exact --draws 12")
    assert "skipped: cmu: no clips here" in capsys.readouterr().out
    assert set(table["problem"]) == {"gait", "gait-sparse"}
    assert fails("compare", "all", "gait") == "problems must be names or all, got all gait"


def test_calibration_within_a_budget_resumes(tmp_path, capsys):
    words = "gait-sparse(frames=4,components=6) walk2d --samplers mh --draws 20 --calibrate 10"
    for _ in range(2):
        compare(tmp_path, words + " --evaluations 6000")
        printed = capsys.readouterr().out
    assert "in 10 simulations" in printed
    assert "not calibrated, cannot be simulated: walk2d" in printed
    runs = list((tmp_path / "calibration/runs").rglob("run.json"))
    assert len(runs) == 10
    stored = json.loads(runs[0].read_text())
    assert stored["budget"]["used"] <= 6000
    assert stored["budget"]["settings"]["thin"] >= 1


@pytest.mark.parametrize("workers", ["0", "2"])
def test_interrupted_comparison_keeps_finished_runs(workers, tmp_path, interrupted):
    problem = "gait(frames=4)"
    words = f"compare {problem} --samplers exact mas --draws 40 --out {tmp_path}".split()
    long = ["--settings.mas.steps", "1000000", "--workers", workers]
    stored = tmp_path / "runs" / problem / "exact" / "0"
    message = interrupted([*words, *long], stored)
    assert "1 of 2 runs finished" in message
    assert str(tmp_path) in message
    before = {path: path.stat().st_mtime_ns for path in stored.iterdir()}
    assert main([*words, "--settings.mas.steps", "3", "--workers", "0"]) == 0
    assert {path: path.stat().st_mtime_ns for path in stored.iterdir()} == before
    assert set(pd.read_csv(tmp_path / "table.csv")["sampler"]) == {"exact", "mas"}


def test_show_and_convert_a_motion(tmp_path, capsys):
    path, figure, target = (str(tmp_path / name) for name in ("a.bvh", "a.png", "b.npz"))
    save(make_gait("walk", frames=40), path)
    assert main(["show", path, "--figure", figure]) == 0
    printed = capsys.readouterr().out
    assert "40 frames at 30 fps, 1.30 s" in printed
    assert "17 joints, rooted at pelvis" in printed
    assert Path(figure).read_bytes().startswith(PNG)
    assert main(["convert", path, target, "--fps", "15", "--skeleton", "h36m17"]) == 0
    motion = load(target)
    assert (motion.fps, motion.frames) == (15, 20)
    assert motion.skeleton.joint_names == Skeleton.preset("h36m17").joint_names
    assert main(["convert", path, target, "--skeleton", "smpl22"]) == 0
    assert load(target).rotations.shape == (40, 22, 3, 3)


def test_show_finds_a_network_by_folder_or_name(tmp_path, capsys, monkeypatch, fails):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    shipped = WEIGHTS / "walk2d.safetensors"
    shutil.copy(shipped, "mine/model.safetensors")
    for given, file in (("mine", "mine/model.safetensors"), ("walk2d", shipped)):
        assert main(["show", given]) == 0
        printed = capsys.readouterr().out
        assert printed.startswith(f"{file}: a motion-diffusion of ")
        assert "14 joints, rooted at pelvis" in printed
    message = fails("show", "walk3d")
    assert message.startswith("file must be an existing file or the name of a network, sampler or ")
    assert message.endswith(", got 'walk3d'; did you mean walk2d?")


def test_show_reads_deeplabcut_tables(tmp_path, capsys, fails):
    path = tmp_path / "mouse.csv"
    path.write_text(
        "scorer,net,net,net,net,net,net\nbodyparts,nose,nose,nose,tail,tail,tail\n"
        "coords,x,y,likelihood,x,y,likelihood\n0,1,2,0.5,3,4,1\n1,2,3,0.5,,,0\n"
    )
    assert main(["show", str(path), "--fps", "10"]) == 0
    printed = capsys.readouterr().out
    assert f"{path}: DeepLabCut, 1 keypoint track\n" in printed
    assert "2 frames at 10 fps, 0.10 s, 25% of keypoints missing\n  2 joints, root" in printed
    figure = tmp_path / "mouse.png"
    assert main(["show", str(path), "--figure", str(figure)]) == 0
    assert "2 frames, fps unknown, 25% of keypoints missing" in capsys.readouterr().out
    assert figure.stat().st_size > 1000
    path.write_text(path.read_text().replace(",0.5", ""))
    assert "cells as in the first row" in fails("show", path)


def test_show_scales_landmarks_and_reads_movement(tmp_path, capsys, fails):
    path = tmp_path / "pose.json"
    points = [{"x": 0.5, "y": 0.1, "visibility": 1}] * 33
    frames = [
        {"pose_landmarks": person, "timestamp_ms": t} for person, t in ((points, 0), (None, 40))
    ]
    path.write_text(json.dumps(frames))
    assert "(--image-size WIDTH HEIGHT)" in fails("show", path)
    assert main(["show", str(path), "--image-size", "640", "480"]) == 0
    printed = capsys.readouterr().out
    assert f"{path}: MediaPipe Pose, 1 keypoint track\n" in printed
    assert "2 frames at 25 fps, 0.04 s, 50% of keypoints missing\n  skeleton mediapipe33" in printed
    path = tmp_path / "clip.nc"
    dims = {"time": [0, 1], "space": ["x", "y"], "keypoint": ["nose"], "individual": ["mouse"]}
    positions = xr.DataArray(np.ones((2, 2, 1, 1)), dims, list(dims))
    xr.Dataset({"position": positions}, attrs={"fps": 20.0}).to_netcdf(path, engine="h5netcdf")
    assert main(["show", str(path)]) == 0
    printed = capsys.readouterr().out
    assert f"{path}: movement, 1 keypoint track\n  clip mouse:\n  2 frames at 20 fps" in printed


def test_show_and_convert_draws(tmp_path, capsys, fails):
    compare(tmp_path, "gait --samplers exact --draws 12")
    (path,) = tmp_path.rglob("draws.nc")
    assert main(["show", str(path)]) == 0
    assert "4 x 3 (chains x draws)" in capsys.readouterr().out
    target = tmp_path / "draw.bvh"
    assert main(["convert", str(path), str(target), "--draw", "2"]) == 0
    draw = MotionDraws.load(path).motion(2)
    expected = rigid_motion(draw).retarget(draw.skeleton)
    back = load(target).retarget(draw.skeleton)
    np.testing.assert_allclose(back.positions, expected.positions, atol=1e-4)
    assert fails("convert", path, target, "--draw", "3") == "draw must be 0 to 2, got 3"
    assert fails("convert", target, target, "--draw", "0").startswith("draw requires a file of dr")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("compare gait --samplers mcmc", ("'mcmc'", "exact", "nuts")),
        ("compare gait --samplers nutz", ("got 'nutz'; did you mean nuts?",)),
        ("show nutz", ("got 'nutz'; did you mean nuts?",)),
        ("report .", ("folder must be written by compare(), got '.' without comparison.json",)),
        ("compare gait --samplers exact mh exact", ("samplers must be unique, got exact mh exac",)),
        ("compare gait --samplers mas.best", ("'mas.best'", "mas.reference_code")),
        ("compare jump", ("'jump'", "gait-monocular")),
        ("compare", ("problems must not be empty", "--clips", "--prior")),
        ("compare gait --calibrate 5", ("calibrate must be at least 10, got 5",)),
        ("compare walk2d --calibrate 20", ("calibrate requires a problem that can be sim",)),
        ("compare gait --observe sparse", ("observe requires --clips",)),
        ("compare --prior no/such", ("no/such", "the folder of a training run")),
        ("compare --clips no/such/*.bvh", ("no/such/*.bvh",)),
        ("show no/such.bvh", ("no/such.bvh",)),
        ("convert no/such.bvh out.npz", ("no/such.bvh",)),
        ("draw", ("'draw'", "compare, report, which, list, show, convert")),
    ],
)
def test_invalid_options_are_one_line(words, expected, tmp_path, fails, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = fails(*words.split())
    for part in expected:
        assert part in message


@pytest.mark.parametrize("command", ["show", "compare --out out --clips", "convert"])
def test_damaged_files_are_named(command, tmp_path, fails, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(make_gait("walk"), "half.bvh")
    half = Path("half.bvh").read_text()[:2000]
    files = {"shopping.bvh": "eggs\nmilk\n", "half.bvh": half, "zip.npz": "PK\x03\x04", "a.txt": ""}
    for name, content in files.items():
        Path(name).write_text(content)
        assert name in fails(*command.split(), name, *["out.npz"] * (command == "convert"))


def test_clips_that_are_too_short(tmp_path, fails, write_walks):
    short = write_walks(tmp_path, 2, frames=8)
    assert "frames" in fails("compare", "--clips", short, "--out", tmp_path / "out")


def test_invalid_setting_exits_with_status_2(capsys):
    with pytest.raises(SystemExit) as end:
        main(["compare", "gait", "--settings.mas.n-views", "1"])
    assert end.value.code == 2
    assert "n_views must be an integer of at least 2" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("out", ["taken", "/proc/no-folder-can-be-made-here"])
def test_unwritable_output_folder_is_named(out, tmp_path, fails, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("a file")
    assert out in fails("compare", "gait", "--samplers", "exact", "--draws", "12", "--out", out)


@dataclass(frozen=True)
class Plain:
    kind: str = field(default="plain", init=False)


@dataclass(frozen=True)
class Step:
    size: float = 0.5
    inner: Plain | None = None


def test_objects_are_read_from_text():
    step = Step(0.25, Plain())
    assert object_from_text(" Step( 0.25, inner = Plain ) ", [Plain, Step]) == step
    assert text_of_object(step) == "Step(size=0.25, inner=Plain)"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Leap", "must be one of Plain, Step, got 'Leap'"),
        ("Step(length=1)", "options of Step must be among size, inner, got 'length'"),
        ("Plain(kind='x')", "options of Plain must be among"),
        ("Step(", "must be one of"),
        ("Step(\0)", "must be one of"),
        ("Step(size=__import__('os'))", "."),
        ("3", "must be one of"),
    ],
)
def test_invalid_object_text_is_rejected(text, expected):
    with pytest.raises(ValueError, match=expected):
        object_from_text(text, [Plain, Step])


def test_a_missing_package_prints_one_line(fails, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    assert "safetensors" in fails("show", WEIGHTS / "walk2d.safetensors")

"""``probmotion train diffusion | evaluator | lifter``: files, resuming and error messages."""

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from probmotion import Cameras, Skeleton
from probmotion.cli.main import main
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.lifter import PoseLifter
from probmotion.models.evaluation.pose_flow import PoseFlow

PERSON = Skeleton.preset("person14")
SCRIPT = "import sys; from probmotion.cli.main import main; sys.exit(main())"
ONE_THREAD = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
KINDS = ("diffusion", "evaluator", "lifter", "dvae", "denoiser", "motion-vae")
PARTS = ["--validation", "walk3", "--test", "walk4"]


def words(kind, walks, out, *more):
    given = ["train", kind, "--clips", walks, "--views", "2", "--size", "tiny", *PARTS]
    return [*given, "--out", str(out), *map(str, more)]


@pytest.fixture(scope="module")
def trained(walks, tmp_path_factory):
    """The folder of a run of 20 steps."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(words("diffusion", walks, out, "--steps", 20, "--checkpoint-every", 10)) == 0
    return out


@pytest.fixture
def copied(trained, tmp_path):
    """A copy of the run, to be continued."""
    return shutil.copytree(trained, tmp_path / "run")


def losses(out):
    with open(out / "losses.csv", newline="") as file:
        return list(csv.DictReader(file))


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


# Output.


def test_run_writes_a_prior_that_denoises(trained):
    prior = MotionDiffusion.load(trained)
    assert (prior.skeleton, prior.fps, prior.frames) == (PERSON, 20.0, 20)
    noisy = np.random.default_rng(0).standard_normal((2, 3, 20, 14, 2))
    assert np.isfinite(prior.denoise(noisy, 0.5, Cameras.ring(3))).all()
    assert [row["step"] for row in losses(trained)] == ["10", "20"]
    assert prior.card["step"] == 20
    network = prior.card["network"]
    assert network["data"]["clips"] == ["walk0", "walk1", "walk2"]
    assert network["validation_data"]["clips"] == ["walk3"]
    assert network["data"]["tracks"] == 6
    files = {"losses.csv", "model.safetensors", "state.safetensors"}
    assert {file.name for file in trained.iterdir()} == files


def test_default_data_are_synthetic_walks(tmp_path, capsys):
    given = ["train", "diffusion", "--out", str(tmp_path / "run"), "--size", "tiny"]
    assert main([*given, "--steps", "5", "--views", "1", "--frames", "12"]) == 0
    printed = capsys.readouterr().out
    assert "\nshort " in printed  # the table of preparation steps
    for part in ("train: 48 tracks of 48 clips", "validation: 6 tracks of 6", "test: 6 tracks"):
        assert f"\n{part}" in printed
    assert f"\nwrote {tmp_path / 'run' / 'model.safetensors'}: step 5, loss " in printed
    assert MotionDiffusion.load(tmp_path / "run").frames == 12


def test_data_and_training_options_take_effect(walks, tmp_path):
    more = ["--fps", 15, "--centre", "sequence", "--threshold", 0.4, "--skeleton", "h36m17"]
    steps = ["--steps", 3, "--batch", 7, "--learning-rate", 0.003, "--seed", 4]
    assert main(words("diffusion", walks, tmp_path, *more, *steps)) == 0
    card = MotionDiffusion.load(tmp_path).card
    assert card["network"]["fps"] == 15
    assert card["network"]["threshold"] == 0.4
    assert card["network"]["joint_names"] == list(Skeleton.preset("h36m17").joint_names)
    assert card["network"]["augmentation"]["shift"] > 0
    assert max(np.ravel(card["network"]["deviation"][0])) > 0
    for name, value in {"batch": 7, "learning_rate": 0.003, "seed": 4}.items():
        assert card["training"][name] == value
    assert card["training"]["ema"] == 0.99  # the default of the size


def test_evaluator_on_a_random_split_of_six_clips(write_walks, tmp_path):
    clips = write_walks(tmp_path, 6, frames=60)
    given = ["train", "evaluator", "--clips", clips, "--views", "1", "--size", "tiny"]
    assert main([*given, "--steps", "5", "--out", str(tmp_path / "run")]) == 0
    assert TrackEvaluator.load(tmp_path / "run").skeleton == PERSON


def test_lifter_is_trained_after_its_flow_and_extended_alone(walks, tmp_path, capsys, fails):
    flow, lifter = tmp_path / "flow", tmp_path / "lifter"
    assert main(words("lifter", walks, tmp_path, "--steps", 5)) == 0
    PoseFlow.load(flow)
    PoseLifter.load(lifter)
    before = contents(flow)
    # An interrupted lifter continues with the finished flow.
    shutil.rmtree(lifter)
    capsys.readouterr()
    assert main(words("lifter", walks, tmp_path, "--steps", 5)) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-2].endswith("is finished: 5 of 5 steps")
    assert printed[-1].startswith("wrote ")
    assert main(words("lifter", walks, tmp_path, "--steps", 8)) == 0
    printed = capsys.readouterr().out.splitlines()[-1]
    assert printed.startswith(f"wrote {lifter / 'model.safetensors'}: step 8, loss ")
    # Other data are rejected before the flow is changed.
    assert "out" in fails(*words("lifter", walks, tmp_path, "--steps", 9, "--data-seed", 1))
    assert contents(flow) == before


# Resuming.


def test_finished_run_writes_nothing(walks, copied, capsys):
    before = contents(copied)
    for steps in (20, 15):
        assert main(words("diffusion", walks, copied, "--steps", steps)) == 0
        printed = capsys.readouterr().out.splitlines()[-1]
        assert printed.endswith(f"is finished: 20 of {steps} steps")
        assert contents(copied) == before


def test_folder_of_another_run_is_rejected(walks, copied, fails):
    before = contents(copied)
    for changed, named in {
        ("--batch", "3"): "batch",
        ("--threshold", "0.4"): "threshold",
        ("--data-seed", "1"): "",
    }.items():
        message = fails(*words("diffusion", walks, copied, "--steps", 40), *changed)
        assert re.match(rf"out .*{re.escape(str(copied))}.*{named}", message)
        assert contents(copied) == before


def test_folder_of_another_kind_is_rejected(walks, copied, fails):
    given = words("evaluator", walks, copied, "--steps", 40)
    for gone in ("losses.csv", "state.safetensors"):
        (copied / gone).unlink()
        message = fails(*given)
        assert "motion-diffusion" in message
        assert "track-evaluator" in message
    assert MotionDiffusion.load(copied).card["step"] == 20


def test_ctrl_c_stores_a_checkpoint_from_which_the_command_continues(walks, tmp_path, capsys):
    out = tmp_path / "run"
    given = words("diffusion", walks, out, "--checkpoint-every", 5)
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *given, "--steps", "100000"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ONE_THREAD,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        state = out / "state.safetensors"
        while not state.exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    step = int(MotionDiffusion.load(out).card["step"])
    last = errors.strip().splitlines()[-1]
    assert last.startswith(f"probmotion: stopped at step {step} of 100000")
    assert str(out) in last
    assert "Traceback" not in errors
    files = {"losses.csv", "model.safetensors", "state.safetensors"}
    assert {file.name for file in out.iterdir()} == files
    assert main([*given, "--steps", "1"]) == 0
    assert f"{step} of 1 steps" in capsys.readouterr().out
    assert main([*given, "--steps", str(step + 7)]) == 0
    assert MotionDiffusion.load(out).card["step"] == step + 7


# Invalid input.


def test_invalid_options_are_one_line_and_write_nothing(walks, tmp_path, monkeypatch, fails):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out, table = tmp_path / "run", tmp_path / "table.csv"
    table.write_text("a,b\n")
    base = ["train", "diffusion", "--size", "tiny", "--out", str(out)]
    clips = ["--views", "1", "--clips", walks]
    cases = {
        ("--clips", walks, "--tracks", "a.json"): "clips and tracks are mutually exclusive",
        ("--clips", str(tmp_path / "no.bvh")): "no.bvh: No such file or directory",
        ("--clips", str(tmp_path / "no*.bvh")): "no*.bvh",
        ("--tracks", str(tmp_path / "no.npz")): "no.npz",
        ("--tracks", str(table)): "fps",
        (*clips, "--tracks-fps", "30"): "tracks_fps requires --tracks",
        ("--tracks", "a.json", "--views", "64"): "views applies to 3D clips only",
        ("--skeleton", "own"): "skeleton 'own' requires --tracks",
        ("--skeleton", "cat"): "got 'cat'",
        (*clips,): "clips must be at least 6 for a random split, got 5 (walk0, walk1, walk2, walk",
        (*clips, "--validation", "walk1"): "validation requires test",
        (*clips, "--test", "walk1"): "test requires validation",
        (*clips, "--validation", "walk1", "--test", "walk9"): "test must name clips among walk0, ",
        (*clips, *PARTS, "--threshold", "1.5"): "tracks must contain joints",
        (*clips, "--views", "0"): "views must be an integer of at least 1, got 0",
        (*clips, "--fps", "0"): "fps must be a finite number above 0, got 0.0",
        ("--device", "cuda"): "device",
        ("--steps", "0"): "steps must be an integer of at least 1, got 0",
        ("--frames", "1"): "frames must be an integer of at least 2, got 1",
        ("--seed", "-1"): "seed must be an integer of at least 0, got -1",
    }
    for given, expected in cases.items():
        assert expected in fails(*base, *given), given
        assert not out.exists()
    for given, got in {("train",): "none", ("train", "vae"): "'vae'"}.items():
        assert fails(*given) == f"kind must be one of {', '.join(KINDS)}, got {got}"


@pytest.mark.parametrize(
    "kind", [[k] for k in KINDS if k != "denoiser"] + [["denoiser", "--prior", "x"]]
)
def test_options_are_checked_before_data_are_read(kind, tmp_path, monkeypatch, fails):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    taken = tmp_path / "run"
    taken.write_text("mine")
    given = ["train", *kind, "--clips", str(tmp_path / "no.npz")]
    cases = {
        ("--out", str(taken)): f"out must be a folder, got {taken}; {taken} is a file",
        ("--out", f"{taken}/a/b"): f"out must be a folder, got {taken}/a/b; {taken} is a file",
        ("--out", str(tmp_path / "new"), "--device", "cuda"): "device",
    }
    if kind[0] not in ("dvae", "denoiser"):
        cases["--out", str(tmp_path / "new"), "--threshold", "nan"] = "threshold must be a finite"
    for more, expected in cases.items():
        assert fails(*given, *more).startswith(expected)
    assert taken.read_text() == "mine"
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_help(capsys):
    options = {
        "diffusion": ("--frames", "--tracks", "--views"),
        "evaluator": ("--frames", "--tracks"),
        "lifter": ("--size", "--tracks"),
        "dvae": ("--fps", "--skeleton"),
        "denoiser": ("--prior", "--most"),
        "motion-vae": ("--rest", "--kl"),
    }
    with pytest.raises(SystemExit) as end:
        main(["train", "--help"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    for kind, own in options.items():
        assert f"\n  {kind} " in printed
        with pytest.raises(SystemExit) as end:
            main(["train", kind, "--help"])
        assert end.value.code == 0
        help_text = capsys.readouterr().out
        assert f"usage: probmotion train {kind}" in help_text
        for option in (*own, "--clips", "--validation", "--device", "--steps", "--data-seed"):
            assert option in help_text

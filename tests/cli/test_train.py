"""``probmotion train diffusion | evaluator | lifter``: files, resuming and error messages."""

import csv
import re
import shutil

import numpy as np
import pytest
import torch

from probmotion import Cameras, Skeleton
from probmotion.cli.main import main
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.lifter import PoseLifter

PERSON = Skeleton.preset("person14")
KINDS = ("diffusion", "evaluator", "lifter", "dvae", "denoiser", "motion-vae")
FILES = {".lock", "losses.csv", "model.safetensors", "state.safetensors"}
PARTS = ["--validation", "walk3", "--test", "walk4"]


def command(kind, walks, out, *more):
    args = ["train", kind, "--clips", walks, "--views", "2", "--size", "tiny", *PARTS]
    return [*args, "--out", str(out), *map(str, more)]


@pytest.fixture(scope="module")
def trained(walks, tmp_path_factory):
    """Folder of a run of 20 steps."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(command("diffusion", walks, out, "--steps", 20, "--checkpoint-every", 10)) == 0
    return out


@pytest.fixture
def copied(trained, tmp_path):
    """Folder of a copy of the run, to be continued."""
    return shutil.copytree(trained, tmp_path / "run")


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_run_writes_a_prior_that_denoises(trained):
    prior = MotionDiffusion.load(trained)
    assert (prior.skeleton, prior.fps, prior.frames) == (PERSON, 20.0, 20)
    noisy = np.random.default_rng(0).standard_normal((2, 3, 20, 14, 2))
    assert np.isfinite(prior.denoise(noisy, 0.5, Cameras.ring(3))).all()
    with open(trained / "losses.csv", newline="") as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["10", "20"]
    network = prior.card["network"]
    assert network["data"]["clips"] == ["walk0", "walk1", "walk2"]
    assert network["validation_data"]["clips"] == ["walk3"]
    assert network["data"]["tracks"] == 6
    assert {file.name for file in trained.iterdir()} == FILES


def test_default_data_are_synthetic_walks(tmp_path, capsys):
    args = ["train", "diffusion", "--out", str(tmp_path / "run"), "--size", "tiny"]
    assert main([*args, "--steps", "5", "--views", "1", "--frames", "12"]) == 0
    printed = capsys.readouterr().out
    assert "\nshort " in printed  # the table of preparation steps
    for part in ("train: 48 tracks of 48 clips", "validation: 6 tracks of 6", "test: 6 tracks"):
        assert f"\n{part}" in printed
    assert f"\nwrote {tmp_path / 'run' / 'model.safetensors'}: step 5, loss " in printed
    assert MotionDiffusion.load(tmp_path / "run").frames == 12


def test_data_and_training_options_take_effect(walks, tmp_path):
    more = ["--fps", 15, "--centre", "sequence", "--threshold", 0.4, "--skeleton", "h36m17"]
    steps = ["--steps", 3, "--batch", 7, "--learning-rate", 0.003, "--seed", 4]
    assert main(command("diffusion", walks, tmp_path, *more, *steps)) == 0
    card = MotionDiffusion.load(tmp_path).card
    assert card["network"]["fps"] == 15
    assert card["network"]["threshold"] == 0.4
    assert card["network"]["joint_names"] == list(Skeleton.preset("h36m17").joint_names)
    assert card["network"]["augmentation"]["shift"] > 0
    assert max(np.ravel(card["network"]["deviation"][0])) > 0
    # Without an option, the decay of the average is the default of the size.
    training = {"batch": 7, "learning_rate": 0.003, "seed": 4, "ema": 0.99}
    assert training.items() <= card["training"].items()


def test_evaluator_on_a_random_split_of_six_clips(write_walks, tmp_path):
    clips = write_walks(tmp_path, 6, frames=60)
    args = ["train", "evaluator", "--clips", clips, "--views", "1", "--size", "tiny"]
    assert main([*args, "--steps", "5", "--out", str(tmp_path / "run")]) == 0
    assert TrackEvaluator.load(tmp_path / "run").skeleton == PERSON


def test_lifter_is_trained_after_its_flow_and_extended_without_it(walks, tmp_path, capsys, fails):
    flow, lifter = tmp_path / "flow", tmp_path / "lifter"
    assert main(command("lifter", walks, tmp_path, "--steps", 5)) == 0
    before = contents(flow)
    # An interrupted lifter continues with the finished flow.
    shutil.rmtree(lifter)
    for steps in (5, 8):
        assert main(command("lifter", walks, tmp_path, "--steps", steps)) == 0
        last = capsys.readouterr().out.splitlines()[-1]
        assert last.startswith(f"wrote {lifter / 'model.safetensors'}: step {steps}, loss ")
    PoseLifter.load(lifter)
    # Other data are rejected before the flow is changed.
    assert "data must be the same" in fails(
        *command("lifter", walks, tmp_path, "--steps", 9, "--data-seed", 1)
    )
    assert contents(flow) == before


def test_finished_run_writes_nothing(walks, copied, capsys):
    before = contents(copied)
    for steps in (20, 15):
        assert main(command("diffusion", walks, copied, "--steps", steps)) == 0
        printed = capsys.readouterr().out.splitlines()[-1]
        assert printed.endswith(f"is finished: 20 of {steps} steps")
        assert contents(copied) == before


@pytest.mark.parametrize(
    ("option", "value", "named"),
    [("--batch", "3", "batch"), ("--threshold", "0.4", "threshold"), ("--data-seed", "1", ".*")],
)
def test_folder_of_another_run_is_rejected(walks, copied, fails, option, value, named):
    before = contents(copied)
    message = fails(*command("diffusion", walks, copied, "--steps", 40, option, value))
    assert re.match(rf"{named} must be .* to resume {re.escape(str(copied))}, got", message)
    assert contents(copied) == before


def test_folder_of_another_kind_is_rejected(walks, copied, fails):
    for missing in ("losses.csv", "state.safetensors"):
        (copied / missing).unlink()
        message = fails(*command("evaluator", walks, copied, "--steps", 40))
        assert "motion-diffusion" in message
        assert "track-evaluator" in message
    assert MotionDiffusion.load(copied).card["step"] == 20


def test_ctrl_c_stores_a_checkpoint_to_continue_from(walks, tmp_path, capsys, interrupted):
    out = tmp_path / "run"
    args = command("diffusion", walks, out, "--checkpoint-every", 5)
    message = interrupted([*args, "--steps", "100000"], out / "state.safetensors")
    step = int(MotionDiffusion.load(out).card["step"])
    assert message.startswith(f"probmotion: stopped at step {step} of 100000")
    assert str(out) in message
    assert {file.name for file in out.iterdir()} == FILES
    assert main([*args, "--steps", "1"]) == 0
    assert f"{step} of 1 steps" in capsys.readouterr().out
    assert main([*args, "--steps", str(step + 7)]) == 0
    assert MotionDiffusion.load(out).card["step"] == step + 7


def test_invalid_options_give_one_error_line_and_no_files(walks, tmp_path, monkeypatch, fails):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out, table = tmp_path / "run", tmp_path / "table.csv"
    table.write_text("a,b\n")
    base = f"train diffusion --size tiny --out {out}".split()
    clips = f"--views 1 --clips {walks}"
    cases = {
        f"--clips {walks} --tracks a.json": "clips and tracks are mutually exclusive",
        f"--clips {tmp_path}/no.bvh": "no.bvh: No such file or directory",
        f"--clips {tmp_path}/no*.bvh": "no*.bvh",
        f"--tracks {tmp_path}/no.npz": "no.npz",
        f"--tracks {table}": "expected the rows scorer",
        f"{clips} --tracks-fps 30": "tracks_fps requires --tracks",
        "--tracks a.json --views 64": "views applies to 3D clips only",
        "--skeleton own": "skeleton 'own' requires --tracks",
        "--skeleton cat": "got 'cat'",
        clips: "clips must be at least 6 for a random split, got 5 (walk0, walk1, walk2, walk",
        f"{clips} --test walk1": "test requires validation",
        f"{clips} --validation walk1 --test walk9": "test must name clips among walk0, ",
        f"{clips} --validation walk3 --test walk4 --threshold 1.5": "tracks must contain joints",
        f"{clips} --views 0": "views must be an integer of at least 1, got 0",
        f"{clips} --fps 0": "fps must be a finite number above 0, got 0.0",
        "--device cuda": "device",
        "--steps 0": "steps must be an integer of at least 1, got 0",
        "--frames 1": "frames must be an integer of at least 2, got 1",
        "--seed -1": "seed must be an integer of at least 0, got -1",
    }
    for options, expected in cases.items():
        assert expected in fails(*base, *options.split()), options
        assert not out.exists()
    for args, got in {("train",): "none", ("train", "vae"): "'vae'"}.items():
        assert fails(*args) == f"kind must be one of {', '.join(KINDS)}, images, got {got}"


@pytest.mark.parametrize(
    "kind", [[k] for k in KINDS if k != "denoiser"] + [["denoiser", "--prior", "x"]]
)
def test_options_are_checked_before_data_are_read(kind, tmp_path, monkeypatch, fails):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    file = tmp_path / "run"
    file.write_text("mine")
    args = ["train", *kind, "--clips", str(tmp_path / "no.npz")]
    cases = {
        ("--out", str(file)): f"out must be a folder, got {file}; {file} is a file",
        ("--out", f"{file}/a/b"): f"out must be a folder, got {file}/a/b; {file} is a file",
        ("--out", str(tmp_path / "new"), "--device", "cuda"): "device",
    }
    if kind[0] not in ("dvae", "denoiser"):
        cases["--out", str(tmp_path / "new"), "--threshold", "nan"] = "threshold must be a finite"
    for more, expected in cases.items():
        assert fails(*args, *more).startswith(expected)
    assert file.read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("kind", ["", *KINDS])
def test_help(kind, capsys):
    with pytest.raises(SystemExit) as end:
        main(["train", *kind.split(), "--help"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert f"usage: probmotion train {kind}" in printed
    options = ("--clips", "--validation", "--device", "--steps", "--data-seed") if kind else KINDS
    for option in options:
        assert f" {option} " in printed

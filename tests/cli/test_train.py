"""``probmotion train``: what it writes, how it goes on, and what it says of wrong input."""

from __future__ import annotations

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from probmotion import Cameras, Skeleton
from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import save_motion
from probmotion.models.diffusion.motion_diffusion import KIND, MotionDiffusion
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.lifter import PoseLifter
from probmotion.models.evaluation.pose_flow import PoseFlow
from probmotion.models.training.checkpoints import load_checkpoint

PERSON = Skeleton.preset("person14")
PROGRAM = [sys.executable, "-c", "import sys; from probmotion.cli import main; sys.exit(main())"]
ONE_THREAD = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
KINDS = ("diffusion", "evaluator", "lifter", "dvae", "denoiser", "motion-vae")
# Of three clips, one is watched and one kept.
PARTS = ["--validation", "walk3", "--test", "walk4"]


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A pattern of five clips of two seconds."""
    folder = tmp_path_factory.mktemp("walks")
    for number in range(5):
        save_motion(make_gait("walk", number, frames=60), folder / f"walk{number}.npz")
    return str(folder / "walk*.npz")


def words(kind: str, walks: str, out: Path, *more: object) -> list[str]:
    given = ["train", kind, "--clips", walks, "--views", "2", "--size", "tiny", *PARTS]
    return [*given, "--out", str(out), *map(str, more)]


@pytest.fixture(scope="module")
def trained(walks: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 20 steps; tests that go on take a copy."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(words("diffusion", walks, out, "--steps", 20, "--checkpoint-every", 10)) == 0
    return out


def losses(out: Path) -> list[dict[str, str]]:
    with open(out / "losses.csv", newline="") as file:
        return list(csv.DictReader(file))


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what was said on standard error, which is one line, without the program's name."""
    said = capsys.readouterr().err
    (line,) = (part for part in said.splitlines() if part.startswith("probmotion: "))
    return line.removeprefix("probmotion: ")


# --- what is written ----------------------------------------------------------------------------


def test_a_run_leaves_a_prior_that_denoises(trained: Path) -> None:
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


def test_made_walks_are_learnt_from_by_default(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["train", "diffusion", "--out", str(tmp_path / "run"), "--size", "tiny"]
    assert main([*given, "--steps", "5", "--views", "1", "--frames", "12"]) == 0
    said = capsys.readouterr().out
    assert "\nshort " in said  # what preparation dropped, step by step
    for part in ("train: 48 tracks of 48 clips", "validation: 6 tracks of 6", "test: 6 tracks"):
        assert f"\n{part}" in said
    assert f"\nwrote {tmp_path / 'run' / 'model.safetensors'}: step 5, loss " in said
    assert MotionDiffusion.load(tmp_path / "run").frames == 12


def test_options_of_data_and_training_arrive(walks: str, tmp_path: Path) -> None:
    more = ["--fps", 15, "--centre", "sequence", "--threshold", 0.4, "--skeleton", "h36m17"]
    steps = ["--steps", 3, "--batch", 7, "--learning-rate", 0.003, "--seed", 4]
    assert main(words("diffusion", walks, tmp_path, *more, *steps)) == 0
    card = MotionDiffusion.load(tmp_path).card
    assert card["network"]["fps"] == 15
    assert card["network"]["threshold"] == 0.4
    assert card["network"]["joint_names"] == list(Skeleton.preset("h36m17").joint_names)
    assert card["network"]["augmentation"]["shift"] > 0  # a path has no place of its own
    assert max(np.ravel(card["network"]["deviation"][0])) > 0
    for name, value in {"batch": 7, "learning_rate": 0.003, "seed": 4}.items():
        assert card["training"][name] == value
    # What was not asked for is as the size was tried.
    assert card["training"]["ema"] == 0.99


def test_the_evaluator_is_trained(walks: str, tmp_path: Path) -> None:
    assert main(words("evaluator", walks, tmp_path / "run", "--steps", 5)) == 0
    evaluator = TrackEvaluator.load(tmp_path / "run")
    assert evaluator.skeleton == PERSON


def test_the_lifter_is_trained_after_its_flow(
    walks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = words("lifter", walks, tmp_path / "run", "--steps", 5)
    assert main(given) == 0
    assert {file.name for file in (tmp_path / "run").iterdir()} == {"flow", "lifter"}
    PoseFlow.load(tmp_path / "run" / "flow")
    PoseLifter.load(tmp_path / "run" / "lifter")
    capsys.readouterr()
    # A lifter that was stopped finds its flow finished.
    shutil.rmtree(tmp_path / "run" / "lifter")
    flow = (tmp_path / "run" / "flow" / "model.safetensors").read_bytes()
    assert main(given) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-2].endswith("is finished: it has taken 5 steps of 5")
    assert said[-1].startswith("wrote ")
    assert (tmp_path / "run" / "flow" / "model.safetensors").read_bytes() == flow


def test_more_steps_of_a_lifter_leave_its_flow_alone(
    walks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words("lifter", walks, tmp_path, "--steps", 5)) == 0
    kept = {file.name: file.read_bytes() for file in (tmp_path / "flow").iterdir()}
    assert main(words("lifter", walks, tmp_path, "--steps", 8)) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.startswith(f"wrote {tmp_path / 'lifter' / 'model.safetensors'}: step 8, loss ")
    assert {file.name: file.read_bytes() for file in (tmp_path / "flow").iterdir()} == kept
    # Other data are still refused, and the flow has not learnt from them.
    assert main(words("lifter", walks, tmp_path, "--steps", 9, "--data-seed", 1)) == 2
    assert "which holds a run with " in sentence(capsys)
    assert {file.name: file.read_bytes() for file in (tmp_path / "flow").iterdir()} == kept


def test_real_detections_are_learnt_from(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = str(real_data / "pose2sim_multiview" / "*_T01_*cam_0?.npz")
    clip = "S00_P00_T01_BalancingTrial_cam_0"
    parts = ["--validation", f"{clip}3", "--test", f"{clip}4"]
    given = ["train", "diffusion", "--tracks", files, *parts, "--size", "tiny", "--steps", "5"]
    assert main([*given, "--out", str(tmp_path / "run")]) == 0
    assert f"train: 2 tracks of 2 clips: {clip}1, {clip}2" in capsys.readouterr().out
    prior = MotionDiffusion.load(tmp_path / "run")
    assert (prior.skeleton, prior.fps) == (PERSON, 20.0)
    ankle = PERSON.joint_names.index("left_ankle")
    assert 0.5 < prior.standards.mean[ankle, 1] < 1.1  # metres below the pelvis


# --- going on -----------------------------------------------------------------------------------


def test_a_finished_run_says_so_and_writes_nothing(
    walks: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(trained, tmp_path / "run")
    kept = {file.name: file.read_bytes() for file in out.iterdir()}
    for steps in (20, 15):
        assert main(words("diffusion", walks, out, "--steps", steps)) == 0
        said = capsys.readouterr().out.splitlines()[-1]
        assert said.endswith(f"is finished: it has taken 20 steps of {steps}")
        assert {file.name: file.read_bytes() for file in out.iterdir()} == kept


def test_a_model_that_is_gone_or_damaged_comes_back(
    walks: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(trained, tmp_path / "run")
    model = out / "model.safetensors"
    before = model.read_bytes()
    for damaged in (None, before[:-100]):
        model.unlink() if damaged is None else model.write_bytes(damaged)
        assert main(words("diffusion", walks, out, "--steps", 20)) == 0
        said = capsys.readouterr().out.splitlines()[-1]
        assert said == f"{model} is finished: it has taken 20 steps of 20"
        assert model.read_bytes() == before


def test_more_steps_go_on_as_if_there_had_been_no_pause(
    walks: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(trained, tmp_path / "run")
    rows = ["--checkpoint-every", 10]
    assert main(words("diffusion", walks, out, "--steps", 40, *rows)) == 0
    assert "step 40, loss" in capsys.readouterr().out.splitlines()[-1]
    assert main(words("diffusion", walks, tmp_path / "whole", "--steps", 40, *rows)) == 0
    paused, whole = (load_checkpoint(folder, KIND) for folder in (out, tmp_path / "whole"))
    for name, tensor in whole.tensors.items():
        torch.testing.assert_close(paused.tensors[name], tensor, rtol=0, atol=0)
    for one, other in zip(losses(out), losses(tmp_path / "whole"), strict=True):
        for name in ("step", "loss", "validation_loss"):
            assert one[name] == other[name]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (["--batch", "3"], "batch 64, expected 3"),
        (["--seed", "1"], "seed 0, expected 1"),
        (["--learning-rate", "0.1"], "learning_rate 0.002, expected 0.1"),
        (["--frames", "12"], "another size, expected the same"),
        (["--threshold", "0.4"], "threshold 0.3, expected 0.4"),
        (["--data-seed", "1"], ".*"),
        (["--views", "3"], ".*"),
    ],
)
def test_a_folder_holds_one_run(
    walks: str,
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changed: list[str],
    named: str,
) -> None:
    out = shutil.copytree(trained, tmp_path / "run")
    kept = {file.name: file.read_bytes() for file in out.iterdir()}
    assert main([*words("diffusion", walks, out, "--steps", 40), *changed]) == 2
    said = sentence(capsys)
    assert re.match(rf"out is {re.escape(str(out))}, which holds a run with {named}; give", said)
    assert {file.name: file.read_bytes() for file in out.iterdir()} == kept


def test_a_folder_of_another_kind_is_left_alone(
    walks: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(trained, tmp_path / "run")
    assert main(words("evaluator", walks, out, "--steps", 40)) == 2
    named = "holds a motion-diffusion{0}, expected a track-evaluator{0}"
    assert named.format(" in training") in sentence(capsys)
    (out / "state.safetensors").unlink()
    assert main(words("evaluator", walks, out, "--steps", 40)) == 2
    assert named.format("") in sentence(capsys)
    assert MotionDiffusion.load(out).card["step"] == 20


def wait_for(process: subprocess.Popen[str], ready: Path) -> None:
    for _ in range(600):
        if ready.exists() or process.poll() is not None:
            return
        time.sleep(0.05)


def test_ctrl_c_keeps_what_there_is_and_the_same_command_goes_on(
    walks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    given = words("diffusion", walks, out, "--checkpoint-every", 5)
    process = subprocess.Popen(
        [*PROGRAM, *given, "--steps", "100000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ONE_THREAD,
    )
    try:
        wait_for(process, out / "state.safetensors")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    last = said.strip().splitlines()[-1]
    step = int(MotionDiffusion.load(out).card["step"])
    assert last == (
        f"probmotion: stopped at step {step} of 100000, which is kept in {out}; the same command "
        "goes on from there"
    )
    assert "Traceback" not in said
    assert {file.name for file in out.iterdir()} == {
        "losses.csv", "model.safetensors", "state.safetensors",
    }  # fmt: skip
    # Fewer steps than were taken: no more are.
    assert main([*given, "--steps", "1"]) == 0
    assert f"taken {step} steps of 1" in capsys.readouterr().out
    assert main([*given, "--steps", str(step + 7)]) == 0
    assert MotionDiffusion.load(out).card["step"] == step + 7


# --- wrong input --------------------------------------------------------------------------------


def test_wrong_words_are_one_sentence(
    walks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = tmp_path / "run"
    table = tmp_path / "table.csv"
    table.write_text("a,b\n")
    filmed_or_not = ["train", "diffusion", "--size", "tiny", "--out", str(out)]
    made = [*filmed_or_not, "--views", "1"]
    cases = {
        ("train",): f"what to train must be one of {', '.join(KINDS)}, got missing",
        ("train", "vae"): f"what to train must be one of {', '.join(KINDS)}, got 'vae'",
        (*made, "--clips", walks, "--tracks", "a.json"): "clips and tracks are both given, "
        "expected one of them",
        (*made, "--clips", str(tmp_path / "no.bvh")): f"{tmp_path / 'no.bvh'}: No such file or "
        "directory",
        (*made, "--clips", str(tmp_path / "no*.bvh")): f"paths has '{tmp_path}/no*.bvh', which "
        "matches no file",
        (
            *filmed_or_not,
            "--tracks",
            str(tmp_path / "no.npz"),
        ): f"there is no file {tmp_path / 'no.npz'}",
        (*filmed_or_not, "--tracks", str(table)): "fps is missing, expected frames per second: "
        f"{table} is a table, which does not hold it",
        (*made, "--clips", walks, "--tracks-fps", "30"): "tracks_fps is given without tracks, "
        "expected --tracks FILE… beside it",
        (*made, "--tracks", "a.json", "--views", "64"): "views is given with tracks, expected it "
        "only where clips are filmed",
        (*made, "--clips", walks): "the number of clips is 5 (walk0, walk1, walk2, walk3, "
        "walk4), too few to keep out a tenth twice, expected at least 6, or --validation NAME and "
        "--test NAME to say which are kept out",
        (*made, "--clips", walks, "--validation", "walk1"): "validation is given without test, "
        "expected clips for both or neither",
        (*made, "--clips", walks, "--test", "walk1"): "test is given without validation, "
        "expected clips for both or neither",
        (*made, "--clips", walks, "--validation", "walk1", "--test", "walk9"): "clips has "
        "'walk9', which names no clip of the 5 tracks, expected only clips that have tracks, of "
        "those that preparation has kept",
        (*made, "--clips", walks, "--views", "0"): "views must be an integer of at least 1, got 0",
        (*made, "--clips", walks, "--fps", "0"): "fps must be a finite number above 0, got 0.0",
        (*made, "--device", "cuda"): "device is 'cuda', but this machine has no CUDA; expected "
        "'cpu'",
        (*made, "--steps", "0"): "steps must be an integer of at least 1, got 0",
        (*made, "--frames", "1"): "frames must be an integer of at least 2, got 1",
        (*made, "--seed", "-1"): "seed must be an integer of at least 0, got -1",
    }
    for given, wanted in cases.items():
        assert main(list(given)) == 2, given
        assert sentence(capsys) == wanted
        assert not out.exists()
    for given, named in {
        (*made, "--skeleton", "cat"): "name must be one of , got 'cat'",
        (*made, "--clips", walks, *PARTS, "--threshold", "1.5"): "tracks has no joint of ",
    }.items():
        assert main(list(given)) == 2, given
        assert sentence(capsys).startswith(named)
        assert not out.exists()


@pytest.mark.parametrize("kind", ["diffusion", "evaluator", "lifter"])
def test_no_cuda_is_told_before_anything_is_read(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    given = ["train", kind, "--clips", "no.npz", "--device", "cuda", "--out", str(tmp_path / "r")]
    assert main(given) == 2
    assert sentence(capsys).startswith("device is 'cuda'")


@pytest.mark.parametrize("kind", ["diffusion", "evaluator", "lifter"])
def test_what_needs_no_data_is_refused_before_any_is_read(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "run"
    taken.write_text("mine")
    given = ["train", kind, "--clips", str(tmp_path / "no.npz")]
    cases = {
        ("--out", str(taken)): f"out is {taken}, which is a file, expected a folder",
        ("--out", str(taken / "a" / "b")): f"out is {taken / 'a' / 'b'}, below {taken} which is a "
        "file, expected a folder",
        ("--out", str(tmp_path / "new"), "--threshold", "nan"): "threshold is nan, expected a "
        "finite number above 0",
    }
    for more, wanted in cases.items():
        assert main([*given, *more]) == 2
        assert sentence(capsys) == wanted
    assert taken.read_text() == "mine"
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_six_clips_have_a_tenth(tmp_path: Path) -> None:
    for number in range(6):
        save_motion(make_gait("walk", number, frames=60), tmp_path / f"walk{number}.npz")
    given = ["train", "evaluator", "--clips", str(tmp_path / "walk*.npz"), "--views", "1"]
    more = ["--size", "tiny", "--steps", "1", "--out", str(tmp_path / "run")]
    assert main([*given, *more]) == 0


def test_a_damaged_checkpoint_is_one_sentence(
    walks: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(trained, tmp_path / "run")
    state = out / "state.safetensors"
    state.write_bytes(state.read_bytes()[:-100])
    assert main(words("diffusion", walks, out, "--steps", 40)) == 2
    assert f"{state} is damaged or no safetensors file" in sentence(capsys)


def test_help_lists_the_kinds_and_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    for word in ("--help", "-h"):
        with pytest.raises(SystemExit) as end:
            main(["train", word])
        assert end.value.code == 0
        said = capsys.readouterr().out
        for kind in KINDS:
            assert f"\n  {kind} " in said
    for kind, own in (("diffusion", "--frames"), ("evaluator", "--frames"), ("lifter", "--size")):
        with pytest.raises(SystemExit) as end:
            main(["train", kind, "--help"])
        assert end.value.code == 0
        said = capsys.readouterr().out
        assert f"usage: probmotion train {kind}" in said
        for option in (own, "--clips", "--tracks", "--validation", "--device", "--steps"):
            assert option in said

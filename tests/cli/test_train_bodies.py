"""``probmotion train dvae | denoiser``: what they write and print, and what wrong input is told."""

from __future__ import annotations

import csv
import re
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from probmotion import Motion, MotionDraws, Skeleton
from probmotion.cli.main import main
from probmotion.cli.train_bodies import Noise
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import save_motion
from probmotion.models.dvae.denoiser_training import usual_denoiser_training
from probmotion.models.dvae.joint_noise import JointNoise
from probmotion.models.dvae.motion_denoiser import KIND as DENOISER, MotionDenoiser
from probmotion.models.dvae.motion_dvae import KIND as DVAE, MotionDVAE
from probmotion.models.dvae.training import usual_dvae_training
from probmotion.models.training.checkpoints import WEIGHTS, load_checkpoint

PERSON = Skeleton.preset("person14")
FILES = {"losses.csv", "model.safetensors", "state.safetensors"}
# Of five clips, one is watched and one kept.
PARTS = ["--validation", "walk3", "--test", "walk4"]


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def walks(folder: Path, n: int = 5, frames: int = 40, fps: float = 30.0) -> str:
    """Write n walks and return a pattern of them."""
    for number in range(n):
        save_motion(make_gait("walk", number, frames=frames, fps=fps), folder / f"walk{number}.npz")
    return str(folder / "walk*.npz")


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> str:
    return walks(tmp_path_factory.mktemp("walks"))


def words(kind: str, clips: str, out: Path, *more: object) -> list[str]:
    given = ["train", kind, "--clips", clips, "--size", "tiny", *PARTS, "--batch", "4"]
    return [*given, "--out", str(out), *map(str, more)]


@pytest.fixture(scope="module")
def prior(clips: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a prior's run of 4 steps; tests that go on take a copy."""
    out = tmp_path_factory.mktemp("runs") / "prior"
    assert main(words("dvae", clips, out, "--steps", 4, "--checkpoint-every", 2)) == 0
    return out


@pytest.fixture(scope="module")
def denoiser(clips: str, prior: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a denoiser's run of 4 steps."""
    out = tmp_path_factory.mktemp("runs") / "denoiser"
    given = words("denoiser", clips, out, "--prior", prior, "--steps", 4, "--hidden", 0.25)
    assert main([*given, "--checkpoint-every", "2"]) == 0
    return out


def losses(out: Path) -> list[dict[str, str]]:
    with open(out / "losses.csv", newline="") as file:
        return [
            {name: value for name, value in row.items() if name != "seconds"}
            for row in csv.DictReader(file)
        ]


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what was said on standard error, which is one line, without the program's name."""
    said = capsys.readouterr().err
    (line,) = (part for part in said.splitlines() if part.startswith("probmotion: "))
    return line.removeprefix("probmotion: ")


# --- what is written and printed ----------------------------------------------------------------


def test_a_run_leaves_a_prior_that_draws_motion(prior: Path) -> None:
    dvae = MotionDVAE.load(prior)
    assert (dvae.skeleton, dvae.fps, dvae.frames) == (PERSON, 30.0, 12)
    assert np.isfinite(dvae.sample(np.random.default_rng(0), 3)).all()
    network = dvae.card["network"]
    assert network["data"]["clips"] == ["walk0", "walk1", "walk2"]
    assert network["data"]["frames"] == 3 * 40
    assert network["validation_data"]["clips"] == ["walk3"]
    usual, annealing = usual_dvae_training("tiny")
    assert network["annealing"] == annealing
    assert dvae.card["training"]["batch"] == 4
    # What was not asked for is as the size was tried.
    assert dvae.card["training"]["ema"] == usual.ema
    assert {file.name for file in prior.iterdir()} == FILES
    # The rest pose is that of the clips that are learnt from.
    hip = PERSON.joint_names.index("left_hip")
    width = [
        np.linalg.norm(walk[:, hip] - walk[:, PERSON.roots[0]], axis=-1).mean()
        for walk in (make_gait("walk", n, frames=40).retarget(PERSON).positions for n in range(3))
    ]
    assert np.linalg.norm(dvae.states.rest[hip]) == pytest.approx(np.mean(width), abs=1e-6)


def test_a_run_leaves_a_denoiser_of_its_prior(prior: Path, denoiser: Path) -> None:
    found = MotionDenoiser.load(denoiser, MotionDVAE.load(prior))
    network = found.card["network"]
    assert network["noise"] == asdict(JointNoise(hidden=0.25))
    assert network["clips"] == ["walk0", "walk1", "walk2"]
    assert network["validation_clips"] == ["walk3"]
    assert network["annealing"] == usual_denoiser_training("tiny")[1]
    assert {file.name for file in denoiser.iterdir()} == FILES


def test_the_options_of_noise_begin_where_noise_does() -> None:
    assert asdict(Noise()) == asdict(JointNoise())


def test_people_who_are_made_are_learnt_from_by_default(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    given = ["--size", "tiny", "--steps", "1", "--fps", "10", "--out", str(out)]
    assert main(["train", "dvae", *given]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "resampled to 10 fps: 84 clips at 30 fps"
    assert said[1] == (
        "train: 2400 frames of 60 clips: walk-0, run-0, march-0, walk-1, run-1, march-1, …"
    )
    assert said[2].startswith("validation: 480 frames of 12 clips: walk-20, ")
    assert said[3].startswith("test: 480 frames of 12 clips: walk-24, ")
    annealing = usual_dvae_training("tiny")[1]
    assert said[4] == f"the weight of KL rises over {annealing} steps, more than the 1 to take"
    assert said[5].startswith(f"wrote {out / 'model.safetensors'}: step 1, loss ")
    assert len(said) == 6
    assert MotionDVAE.load(out).fps == 10


def test_what_was_done_to_clips_is_said(
    clips: str, prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for kind, more in (("dvae", ["--fps", 15]), ("denoiser", ["--prior", prior])):
        fps = 15 if kind == "dvae" else 30
        folder = tmp_path / kind
        folder.mkdir()
        files = walks(folder, 6, frames=80, fps=60.0)
        save_motion(make_gait("walk", 6, frames=8, fps=fps), folder / "walk6.npz")
        assert main(words(kind, files, folder / "run", "--steps", 1, *more)) == 0
        said = [line for line in capsys.readouterr().out.splitlines() if "prior:" not in line]
        frames = 20 if kind == "dvae" else 40
        assert said[:4] == [
            f"resampled to {fps} fps: 6 clips at 60 fps",
            "left out, shorter than 12 frames: 1 clips: walk6",
            f"train: {4 * frames} frames of 4 clips: walk0, walk1, walk2, walk5",
            f"validation: {frames} frames of 1 clips: walk3",
        ]


def test_the_frame_rate_and_joints_of_a_denoiser_are_its_prior_s(
    clips: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own"
    more = ["--skeleton", "h36m17", "--fps", 20, "--steps", 1]
    assert main(words("dvae", clips, own, *more)) == 0
    assert MotionDVAE.load(own).skeleton == Skeleton.preset("h36m17")
    capsys.readouterr()
    assert main(words("denoiser", clips, tmp_path / "run", "--prior", own, "--steps", 1)) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "prior: 17 joints, windows of 12 frames at 20 fps"
    assert said[1] == "resampled to 20 fps: 5 clips at 30 fps"
    assert MotionDenoiser.load(tmp_path / "run", MotionDVAE.load(own)).prior.fps == 20


def test_a_seed_splits_six_clips_or_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["train", "dvae", "--clips", walks(tmp_path, 6), "--size", "tiny", "--steps", "1"]
    parts = []
    for seed in (0, 0, 1):
        out = str(tmp_path / f"run{len(parts)}")
        assert main([*given, "--data-seed", str(seed), "--out", out]) == 0
        said = capsys.readouterr().out
        parts.append(re.findall(r"(?:train|validation|test): .* clips: (.*)", said))
    assert [len(names.split(", ")) for names in parts[0]] == [4, 1, 1]
    assert sorted(", ".join(parts[0]).split(", ")) == [f"walk{n}" for n in range(6)]
    assert parts[0] == parts[1] != parts[2]


# --- going on -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["dvae", "denoiser"])
def test_more_steps_go_on_as_if_there_had_been_no_pause(
    kind: str,
    clips: str,
    prior: Path,
    denoiser: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    more = ["--prior", prior, "--hidden", 0.25] if kind == "denoiser" else []
    begun, name = (denoiser, DENOISER) if kind == "denoiser" else (prior, DVAE)
    paused, whole = shutil.copytree(begun, tmp_path / "paused"), tmp_path / "whole"
    rows = ["--checkpoint-every", 2, *more]
    assert main(words(kind, clips, paused, "--steps", 4, *rows)) == 0
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == f"{paused / 'model.safetensors'} is finished: it has taken 4 steps of 4"
    for out in (paused, whole):
        assert main(words(kind, clips, out, "--steps", 8, *rows)) == 0
        said = capsys.readouterr().out.splitlines()[-1]
        assert said.startswith(f"wrote {out / 'model.safetensors'}: step 8, loss ")
    one, other = (load_checkpoint(folder, name) for folder in (paused, whole))
    for tensor in other.tensors:
        torch.testing.assert_close(one.tensors[tensor], other.tensors[tensor], rtol=0, atol=0)
    assert losses(paused) == losses(whole)


def test_a_folder_holds_one_run(
    clips: str, prior: Path, denoiser: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for kind, begun, changed, named in (
        ("dvae", prior, ["--seed", "1"], "seed 0, expected 1"),
        ("dvae", prior, ["--fps", "15"], ".*"),
        ("denoiser", denoiser, ["--prior", prior], "noise .*"),
    ):
        out = shutil.copytree(begun, tmp_path / "run")
        kept = {file.name: file.read_bytes() for file in out.iterdir()}
        assert main([*words(kind, clips, out, "--steps", 8), *map(str, changed)]) == 2
        said = sentence(capsys)
        assert re.match(f"out is {re.escape(str(out))}, which holds a run with {named}; give", said)
        assert {file.name: file.read_bytes() for file in out.iterdir()} == kept
        shutil.rmtree(out)


def test_a_prior_s_folder_is_not_written_over(
    clips: str, prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(prior, tmp_path / "run")
    given = words("denoiser", clips, out, "--prior", out, "--steps", 8)
    for gone, named in (("losses.csv", " in training"), ("state.safetensors", "")):
        (out / gone).unlink()
        assert main(given) == 2
        assert f"holds a {DVAE}{named}, expected a {DENOISER}{named}" in sentence(capsys)
    assert MotionDVAE.load(out).card["step"] == 4


# --- other commands -----------------------------------------------------------------------------


def test_show_says_what_a_prior_is(prior: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(prior)]) == 0
    said = capsys.readouterr().out.splitlines()
    dvae = MotionDVAE.load(prior)
    numbers = sum(tensor.numel() for tensor in dvae.model.state_dict().values())
    assert said[0] == f"{prior / 'model.safetensors'}: a motion-dvae of {numbers} numbers"
    assert said[1].startswith("  frames 12, latent 6, hidden 32, ")
    assert said[2:5] == [
        "  14 joints below pelvis, 6 left-right pairs",
        "  windows of 12 frames at 30 fps, 0.37 s",
        "  learnt from 120 frames of 3 clips: walk0, walk1, walk2",
    ]
    last = losses(prior)[-1]
    assert said[5].startswith("  step 4 of 4, batches of 4, ")
    assert said[5].endswith(
        f"loss {float(last['loss']):.4f}, validation loss {float(last['validation_loss']):.4f}"
    )
    assert len(said) == 6


def test_show_says_what_a_denoiser_is(denoiser: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(denoiser / "model.safetensors")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith(f"{denoiser / 'model.safetensors'}: a motion-denoiser of ")
    assert said[2:6] == [
        "  14 joints below pelvis, 6 left-right pairs",
        "  windows of 12 frames at 30 fps, 0.37 s",
        "  learnt from noisy joints of 3 clips: walk0, walk1, walk2",
        "  noise of 0.01 to 0.08 m, outliers in 40% of windows, hidden joints in 25%",
    ]
    assert said[6].startswith("  step 4 of 4, batches of 4, ")


def test_compare_draws_from_a_prior_of_one_s_own(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    given = "compare --samplers mh mas --draws 12 --settings.mh.warmup 10 --settings.mh.thin 2"
    where = ["--workers", "0", "--prior", str(prior), "--out", str(out)]
    assert main([*given.split(), *where]) == 0
    table = pd.read_csv(out / "table.csv")
    assert set(table["problem"]) == {"prior"}
    assert "density_evaluations" in set(table[table["sampler"] == "mh"]["metric"])
    draws = MotionDraws.load(out / "cells" / "prior" / "mh" / "0" / "draws.nc")
    assert (draws.skeleton, draws.fps) == (PERSON, 30.0)
    # Who needs another prior says so.
    assert list(table[table["sampler"] == "mas"]["metric"]) == ["unsupported"]


def test_only_priors_are_drawn_from(
    denoiser: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for source, kind in ((str(denoiser), DENOISER), ("walk2d-evaluator", "track-evaluator")):
        assert main(["compare", "--prior", source, "--out", str(tmp_path / "out")]) == 2
        assert sentence(capsys) == (
            f"prior is {source}, which holds a {kind}, expected a motion-diffusion or a motion-dvae"
        )
    damaged = tmp_path / "mine.safetensors"
    damaged.write_bytes((denoiser / "model.safetensors").read_bytes()[:1000])
    assert main(["compare", "--prior", str(damaged), "--out", str(tmp_path / "out")]) == 2
    assert sentence(capsys).startswith(f"{damaged} is damaged or of another program")
    assert not (tmp_path / "out").exists()


# --- wrong input --------------------------------------------------------------------------------


def with_nan(folder: Path) -> str:
    path = folder / "torn.npz"
    save_motion(make_gait("walk", 0, frames=40), path)
    with np.load(path) as kept:
        arrays = dict(kept)
    arrays["positions"][3, 2] = np.nan
    np.savez(path, **arrays)
    return str(path)


def without_knees(folder: Path) -> str:
    whole = make_gait("walk", 0, frames=40)
    kept = [j for j, name in enumerate(whole.skeleton.joint_names) if "knee" not in name.lower()]
    path = folder / "kneeless.npz"
    save_motion(Motion(whole.positions[:, kept], whole.skeleton.subset(kept), whole.fps), path)
    return str(path)


def test_wrong_words_are_one_sentence(
    clips: str, prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    (tmp_path / "short").mkdir()
    short = walks(tmp_path / "short", 6, frames=7)
    twin = Path(shutil.copy(tmp_path / "short" / "walk1.npz", tmp_path / "walk1.npz"))
    twins = sorted([str(twin), clips.replace("*", "1")])
    still = tmp_path / "still.npz"
    save_motion(replace(make_gait("walk", 0, frames=40).window(0, 1), name="still"), still)
    large = tmp_path / "large.npz"
    walk = make_gait("walk", 0, frames=40)
    save_motion(replace(walk, positions=1000 * walk.positions, name="large"), large)
    named = "is given without clips, expected --clips FILE… beside it"
    both = "expected clips for both or neither"
    none = "clips has none of 12 frames or more at 30 frames per second, expected some; the longest"
    dvae, denoising = ["train", "dvae"], ["train", "denoiser", "--prior", str(prior)]
    cases = {
        ("--clips", short): f"{none} has 7",
        ("--clips", str(still)): f"{none} has 1",
        ("--clips", clips): "the number of clips is 5 (walk0, walk1, walk2, walk3, walk4), too few "
        "to keep out a tenth twice, expected at least 6, or --validation NAME and --test NAME to "
        "say which are kept out",
        ("--clips", clips, "--validation", "walk1"): f"validation is given without test, {both}",
        ("--clips", clips, "--test", "walk1"): f"test is given without validation, {both}",
        ("--clips", clips, "--validation", "walk1", "--test", "walk1"): "test has 'walk1', which "
        "validation has too, expected other clips",
        ("--clips", clips, "--validation", "walk9", "--test", "walk1"): "validation has 'walk9', "
        "which names no clip, expected some of walk0, walk1, walk2, walk3, walk4",
        (
            *("--clips", clips, "--validation", "walk0", "walk1", "walk2"),
            *("--test", "walk3", "walk4"),
        ): "validation and test have every clip, expected some to learn from",
        ("--validation", "walk-0"): f"validation {named}",
        ("--test", "walk-0"): f"test {named}",
        ("--clips", clips, str(twin)): f"clips has {' and '.join(twins)}, expected "
        "files of other names: a clip is called as its file",
        ("--clips", str(tmp_path / "no.npz")): f"{tmp_path / 'no.npz'}: No such file or directory",
        ("--clips", clips, str(large)): "large has a bone of length 500, to neck, expected "
        "metres, at most 3",
        ("--steps", "0"): "steps must be an integer of at least 1, got 0",
        ("--data-seed", "-1"): "data_seed must be an integer of at least 0, got -1",
    }
    for kind in (dvae, denoising):
        for given, wanted in cases.items():
            assert main([*kind, "--size", "tiny", "--out", str(out), *given]) == 2, given
            assert sentence(capsys) == wanted
            assert not out.exists()


def test_a_clip_that_cannot_be_learnt_from_is_named(
    clips: str, prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    torn, kneeless = with_nan(tmp_path), without_knees(tmp_path)
    for kind, more in (("dvae", []), ("denoiser", ["--prior", str(prior)])):
        given = ["train", kind, *more, "--size", "tiny", *PARTS, "--out", str(out), "--clips"]
        assert main([*given, clips, torn]) == 2
        said = sentence(capsys)
        assert torn in said
        assert "NaN" in said
        assert main([*given, clips, kneeless]) == 2
        assert sentence(capsys).startswith(
            "clips has kneeless, which cannot be learnt from: skeleton has the joint 'left_knee', "
            "which has no counterpart in the motion"
        )
        assert not out.exists()


def test_options_of_one_kind_that_are_wrong(
    clips: str, denoiser: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    cases = {
        ("dvae", "--fps", "0"): "fps must be a finite number above 0, got 0.0",
        ("dvae", "--fps", "nan"): "fps must be a finite number above 0, got nan",
        ("dvae", "--skeleton", "cat"): "name must be one of , got 'cat'",
        ("dvae", "--skeleton", "h36m17"): "clips has walk-0, which cannot be learnt from: ",
        ("denoiser", "--prior", "walk2d"): f"{WEIGHTS / 'walk2d.safetensors'} holds a "
        "motion-diffusion, expected a motion-dvae",
        ("denoiser", "--prior", str(denoiser)): f"{denoiser / 'model.safetensors'} holds a "
        "motion-denoiser, expected a motion-dvae",
        ("denoiser", "--prior", "no/such"): "there is no checkpoint no/such, expected ",
        ("denoiser", "--prior", "x", "--least", "0"): "least is 0.0, expected ",
        ("denoiser", "--prior", "x", "--least", "0.1"): "most must be at least least=0.1, got 0.08",
        ("denoiser", "--prior", "x", "--most", "inf"): "most must be a finite number, got inf",
        ("denoiser", "--prior", "x", "--outliers", "2"): "outliers must be a share, got 2.0",
        ("denoiser", "--prior", "x", "--hidden", "-1"): "hidden must be a share, got -1.0",
    }
    for given, wanted in cases.items():
        assert main(["train", *given, "--size", "tiny", "--out", str(out)]) == 2, given
        assert sentence(capsys).startswith(wanted)
        assert not out.exists()


@pytest.mark.parametrize("kind", [["dvae"], ["denoiser", "--prior", "no"]])
def test_what_needs_no_data_is_refused_before_any_is_read(
    kind: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    taken = tmp_path / "run"
    taken.write_text("mine")
    given = ["train", *kind, "--clips", str(tmp_path / "no.npz")]
    cases = {
        ("--out", str(taken)): f"out is {taken}, which is a file, expected a folder",
        ("--out", str(taken / "a")): f"out is {taken / 'a'}, below {taken} which is a file, "
        "expected a folder",
        ("--out", str(tmp_path / "new"), "--device", "cuda"): "device is 'cuda', but this machine "
        "has no CUDA; expected 'cpu'",
    }
    for more, wanted in cases.items():
        assert main([*given, *more]) == 2
        assert sentence(capsys) == wanted
    assert [file.name for file in tmp_path.iterdir()] == ["run"]
    assert taken.read_text() == "mine"


@pytest.mark.parametrize(
    ("kind", "own"), [("dvae", ["--fps", "--skeleton"]), ("denoiser", ["--prior", "--most"])]
)
def test_help_lists_every_option(
    kind: str, own: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["train", kind, "--help"])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert f"usage: probmotion train {kind}" in said
    for option in (*own, "--size", "--clips", "--validation", "--data-seed", "--device", "--steps"):
        assert option in said

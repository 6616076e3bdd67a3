"""``probmotion train dvae | denoiser``: files, output, resuming and error messages."""

import csv
import re
import shutil
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest

from probmotion import Motion, MotionDraws, Skeleton
from probmotion.cli.main import main
from probmotion.cli.train_bodies import Noise
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import save
from probmotion.models.dvae.denoiser_training import usual_denoiser_training
from probmotion.models.dvae.joint_noise import JointNoise
from probmotion.models.dvae.motion_denoiser import KIND as DENOISER, MotionDenoiser
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.training import usual_dvae_training

PERSON = Skeleton.preset("person14")
FILES = {".lock", "losses.csv", "model.safetensors", "state.safetensors"}
PARTS = ["--validation", "walk3", "--test", "walk4"]


@pytest.fixture(scope="module")
def clips(write_walks, tmp_path_factory):
    return write_walks(tmp_path_factory.mktemp("walks"))


def command(kind, clips, out, *more):
    args = ["train", kind, "--clips", clips, "--size", "tiny", *PARTS, "--batch", "4"]
    return [*args, "--out", str(out), *map(str, more)]


@pytest.fixture(scope="module")
def prior(clips, tmp_path_factory):
    """Folder of a prior trained for 4 steps."""
    out = tmp_path_factory.mktemp("runs") / "prior"
    assert main(command("dvae", clips, out, "--steps", 4, "--checkpoint-every", 2)) == 0
    return out


@pytest.fixture(scope="module")
def denoiser(clips, prior, tmp_path_factory):
    """Folder of a denoiser trained for 4 steps."""
    out = tmp_path_factory.mktemp("runs") / "denoiser"
    args = command("denoiser", clips, out, "--prior", prior, "--steps", 4, "--hidden", 0.25)
    assert main([*args, "--checkpoint-every", "2"]) == 0
    return out


def test_run_writes_a_prior_that_samples(prior):
    dvae = MotionDVAE.load(prior)
    assert (dvae.skeleton, dvae.fps, dvae.frames) == (PERSON, 30.0, 12)
    assert np.isfinite(dvae.sample(np.random.default_rng(0), 3)).all()
    network = dvae.card["network"]
    data = {"clips": ["walk0", "walk1", "walk2"], "frames": 3 * 40}
    assert data.items() <= network["data"].items()
    assert network["validation_data"]["clips"] == ["walk3"]
    defaults, annealing = usual_dvae_training("tiny")
    assert network["annealing"] == annealing
    assert (dvae.card["training"]["batch"], dvae.card["training"]["ema"]) == (4, defaults.ema)
    assert {file.name for file in prior.iterdir()} == FILES


def test_run_writes_a_denoiser_of_its_prior(prior, denoiser):
    network = MotionDenoiser.load(denoiser, MotionDVAE.load(prior)).card["network"]
    assert network["noise"] == asdict(JointNoise(hidden=0.25))
    assert network["clips"] == ["walk0", "walk1", "walk2"]
    assert network["validation_clips"] == ["walk3"]
    assert network["annealing"] == usual_denoiser_training("tiny")[1]
    assert {file.name for file in denoiser.iterdir()} == FILES
    assert asdict(Noise()) == asdict(JointNoise())  # the same defaults


def test_default_data_are_synthetic_people(tmp_path, capsys):
    out = tmp_path / "run"
    args = f"train dvae --size tiny --steps 1 --fps 10 --out {out}"
    assert main(args.split()) == 0
    expected = [
        "resampled from 30 to 10 fps: 84 of 84 clips",
        "train: 2400 frames of 60 clips: walk-0, run-0, march-0, walk-1, run-1, march-1, …",
        "validation: 480 frames of 12 clips: walk-20, ",
        "test: 480 frames of 12 clips: walk-24, ",
        f"KL annealing takes {usual_dvae_training('tiny')[1]} steps, but this run has 1",
        f"wrote {out / 'model.safetensors'}: step 1, loss ",
    ]
    for line, beginning in zip(capsys.readouterr().out.splitlines(), expected, strict=True):
        assert line.startswith(beginning)
    assert MotionDVAE.load(out).fps == 10


def test_resampled_and_skipped_clips_are_printed(write_walks, tmp_path, capsys):
    files = write_walks(tmp_path / "clips", 6, frames=80, fps=60.0)
    save(make_gait("walk", 6, frames=8, fps=15), tmp_path / "clips" / "walk6.npz")
    assert main(command("dvae", files, tmp_path / "run", "--steps", 1, "--fps", 15)) == 0
    assert capsys.readouterr().out.splitlines()[:4] == [
        "resampled from 60 to 15 fps: 6 of 7 clips",
        "skipped, shorter than 12 frames: 1 clip: walk6",
        "train: 80 frames of 4 clips: walk0, walk1, walk2, walk5",
        "validation: 20 frames of 1 clip: walk3",
    ]


def test_denoiser_uses_the_joints_and_frame_rate_of_its_prior(clips, tmp_path, capsys):
    prior, out = tmp_path / "prior", tmp_path / "run"
    more = ["--skeleton", "h36m17", "--fps", 20, "--steps", 1]
    assert main(command("dvae", clips, prior, *more)) == 0
    assert MotionDVAE.load(prior).skeleton == Skeleton.preset("h36m17")
    capsys.readouterr()
    assert main(command("denoiser", clips, out, "--prior", prior, "--steps", 1)) == 0
    assert capsys.readouterr().out.splitlines()[:2] == [
        "prior: 17 joints, windows of 12 frames at 20 fps",
        "resampled from 30 to 20 fps: 5 of 5 clips",
    ]
    assert MotionDenoiser.load(out, MotionDVAE.load(prior)).prior.fps == 20


def test_data_seed_splits_six_clips(write_walks, tmp_path, capsys):
    clips, parts = write_walks(tmp_path, 6), []
    for run, seed in enumerate((0, 0, 1)):
        args = f"train dvae --clips {clips} --size tiny --steps 1 --data-seed {seed} --out"
        assert main([*args.split(), str(tmp_path / f"run{run}")]) == 0
        printed = capsys.readouterr().out
        parts.append(re.findall(r"(?:train|validation|test): .* clips?: (.*)", printed))
    assert [len(names.split(", ")) for names in parts[0]] == [4, 1, 1]
    assert sorted(", ".join(parts[0]).split(", ")) == [f"walk{n}" for n in range(6)]
    assert parts[0] == parts[1] != parts[2]


@pytest.mark.parametrize("kind", ["dvae", "denoiser"])
def test_more_steps_extend_a_run(kind, clips, prior, denoiser, tmp_path, capsys):
    more = ["--prior", prior, "--hidden", 0.25] if kind == "denoiser" else []
    out = shutil.copytree(denoiser if kind == "denoiser" else prior, tmp_path / "run")
    for steps, expected in ((4, "is finished: 4 of 4 steps"), (6, ": step 6, loss ")):
        assert main(command(kind, clips, out, "--steps", steps, *more)) == 0
        assert expected in capsys.readouterr().out.splitlines()[-1]


def test_show_summarises_priors_and_denoisers(prior, denoiser, capsys):
    assert main(["show", str(prior)]) == 0
    printed = capsys.readouterr().out.splitlines()
    numbers = sum(t.numel() for t in MotionDVAE.load(prior).model.state_dict().values())
    assert printed[0] == f"{prior / 'model.safetensors'}: a motion-dvae of {numbers} parameters"
    assert printed[1].startswith("  frames 12, latent 6, hidden 32, ")
    body = [
        "  14 joints, rooted at pelvis, 6 left-right pairs",
        "  windows of 12 frames at 30 fps, 0.37 s",
    ]
    assert printed[2:5] == [*body, "  trained on 120 frames of 3 clips: walk0, walk1, walk2"]
    assert printed[5].startswith("  step 4 of 4, batches of 4, ")
    with open(prior / "losses.csv", newline="") as file:
        *_, last = csv.DictReader(file)
    loss, validation = float(last["loss"]), float(last["validation_loss"])
    assert printed[5].endswith(f"loss {loss:.4f}, validation loss {validation:.4f}")
    assert main(["show", str(denoiser / "model.safetensors")]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith(f"{denoiser / 'model.safetensors'}: a motion-denoiser of ")
    assert printed[2:6] == [
        *body,
        "  trained on noisy joints of 3 clips: walk0, walk1, walk2",
        "  noise of 0.01 to 0.08 m, outliers in 40% of windows, occlusion in 25%",
    ]


def test_compare_samples_a_trained_prior(prior, tmp_path):
    command = f"compare --samplers mh mas --draws 12 --workers 0 --prior {prior} --out {tmp_path}"
    assert main([*command.split(), "--settings.mh.warmup", "10", "--settings.mh.thin", "2"]) == 0
    table = pd.read_csv(tmp_path / "table.csv")
    assert set(table["problem"]) == {"prior"}
    assert "density_evaluations" in set(table[table["sampler"] == "mh"]["metric"])
    draws = MotionDraws.load(tmp_path / "runs" / "prior" / "mh" / "0" / "draws.nc")
    assert (draws.skeleton, draws.fps) == (PERSON, 30.0)
    assert list(table[table["sampler"] == "mas"]["metric"]) == ["unsupported"]


def test_compare_rejects_networks_that_are_not_priors(denoiser, tmp_path, fails):
    out = tmp_path / "out"
    for source, kind in ((str(denoiser), DENOISER), ("walk2d-evaluator", "track-evaluator")):
        message = fails("compare", "--prior", source, "--out", out)
        expected = f"prior must be a motion-diffusion or a motion-dvae, got a {kind} in {source}"
        assert message == expected
    damaged = tmp_path / "mine.safetensors"
    damaged.write_bytes((denoiser / "model.safetensors").read_bytes()[:1000])
    assert fails("compare", "--prior", damaged, "--out", out).startswith(f"{damaged} is damaged")
    assert not out.exists()


def test_invalid_clips_give_one_error_line_and_no_files(write_walks, clips, tmp_path, fails):
    out = tmp_path / "run"
    short = write_walks(tmp_path / "short", 6, frames=7)
    twin = shutil.copy(tmp_path / "short" / "walk1.npz", tmp_path / "walk1.npz")
    walk = make_gait("walk", 0, frames=40)
    torn, kneeless, large = (tmp_path / f"{name}.npz" for name in ("torn", "kneeless", "large"))
    save(replace(walk, positions=1000 * walk.positions, name="large"), large)
    legs = [j for j, name in enumerate(walk.skeleton.joint_names) if "knee" not in name.lower()]
    save(Motion(walk.positions[:, legs], walk.skeleton.subset(legs), walk.fps), kneeless)
    save(walk, torn)
    with np.load(torn) as archive:
        arrays = dict(archive)
    arrays["positions"][3, 2] = np.nan
    np.savez(torn, **arrays)
    missing = tmp_path / "no.npz"
    known = "walk0, walk1, walk2, walk3, walk4"
    args = f"--clips {clips}"
    cases = {
        f"--clips {short}": "clips must include one of at least 12 frames at 30 fps, got at most 7",
        args: f"clips must be at least 6 for a random split, got 5 ({known}); name held-out",
        f"{args} --validation walk1": "validation requires test",
        f"{args} --validation walk1 --test walk1": "validation and test must be disj",
        f"{args} --validation walk9 --test walk1": "validation must name clips among "
        f"{known}, got 'walk9'",
        f"{args} --validation walk0 walk1 walk2 --test walk4 walk3": "validation and test must "
        "exclude at least one clip for training",
        "--validation walk-0": "validation requires --clips",
        "--test walk-0": "test requires --clips",
        f"{args} {twin}": "files must have unique names, got ",
        f"--clips {missing}": f"{missing}: No such file or directory",
        f"{args} {large}": f"{large}: bodies must be 0.3 to 3 m large",
        f"{args} {torn}": str(torn),
        f"{args} {kneeless}": "clip kneeless cannot be retargeted: ",
        "--steps 0": "steps must be an integer of at least 1, got 0",
        "--data-seed -1": "data_seed must be an integer of at least 0, got -1",
        "--fps 0": "fps must be a finite number above 0, got 0.0",
        "--skeleton h36m17": "clip walk-0 cannot be retargeted: ",
    }
    for options, expected in cases.items():
        message = fails("train", "dvae", "--size", "tiny", "--out", out, *options.split())
        assert message.startswith(expected), options
        assert not out.exists()


def test_invalid_options_of_the_denoiser(denoiser, tmp_path, fails):
    out = tmp_path / "run"
    for options, expected in {
        "walk2d": "motion-diffusion",
        str(denoiser): "motion-denoiser",
        "no/such": "no/such",
        "x --least 0": "least",
        "x --least 0.1": "most must be at least least=0.1, got 0.08",
        "x --most inf": "most must be a finite number",
        "x --outliers 2": "outliers",
        "x --hidden -1": "hidden",
    }.items():
        args = f"train denoiser --size tiny --out {out} --prior {options}"
        assert expected in fails(*args.split())
        assert not out.exists()

"""``probmotion train images``: rounds, resuming and error messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("torch")
pytest.importorskip("numba", reason="numba is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
from probmotion.cli.main import main
from probmotion.models.images import category as category_module
from probmotion.models.images.category import Category
from probmotion.models.images.encoder_training import encoder_of
from probmotion.models.images.surface import rest_surface
from probmotion.models.latent.turn_code import TurnCode
from probmotion.reconstruction import learning, refinement


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """File of a category without an encoder."""
    body, rng = Category.load("quadruped").body, np.random.default_rng(0)
    turns = 0.15 * rng.standard_normal((4, 1, len(body.bones), 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(category_module, "rest_surface", lambda body: rest_surface(body, 250))
        category = Category.of_capsules("animal", body, TurnCode(0 * turns[0], turns, 10.0))
    path = tmp_path_factory.mktemp("start") / "animal.npz"
    category.save(path)
    return path


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """One step of every optimisation."""
    learn = learning.learn_surface
    monkeypatch.setattr(refinement, "_STAGES", ((32, 4.0, 1),))
    monkeypatch.setattr(learning, "learn_surface", lambda *args, progress: learn(*args, steps=2))


def command(start, out, *more):
    args = f"train images --category {start} --out {out} --images 3 --steps 1 --batch 2"
    return [*args.split(), *map(str, more)]


def write_clip(folder: Path, names=("a", "b"), channels=0) -> Path:
    """Write images of a grey rectangle, its masks, and features if they have channels."""
    mask = np.zeros((40, 60), dtype=np.uint8)
    mask[10:30, 15:45] = 255
    for part in ("images", "masks"):
        (folder / part).mkdir(parents=True)
        for name in names:
            Image.fromarray(mask // 2 if part == "images" else mask).save(
                folder / part / f"{name}.png"
            )
    if channels:
        (folder / "features").mkdir()
        grid = np.random.default_rng(0).standard_normal((4, 6, channels))
        for name in names:
            np.savez(folder / "features" / f"{name}.npz", grid)
    return folder


def test_interrupted_runs_resume_to_the_same_category(start, tmp_path, monkeypatch, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main(command(start, whole)) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith(f"{start} has no encoder beside its file: trained first, in ")
    assert printed[-2:][0] == f"{whole / 'category.npz'}: images: 3, rounds: 2"
    learnt = Category.load(whole / "category.npz")
    assert learnt.name == "whole"
    assert learnt.digest != Category.load(start).digest
    assert encoder_of(learnt).dim > 0
    learn, calls = learning.learn_surface, []

    def interrupted(*args, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return learn(*args, **options)

    monkeypatch.setattr(learning, "learn_surface", interrupted)
    assert main(command(start, parts)) == 130
    assert "stopped in round 2 of 2; finished rounds are saved" in capsys.readouterr().err
    assert Category.load(parts / "category.npz").card["rounds"] == 1
    assert main(command(start, parts)) == 0
    assert len(calls) == 3  # the first round is not repeated
    assert Category.load(parts / "category.npz").digest == learnt.digest
    assert main(command(start, parts)) == 0  # finished: nothing is learnt again
    assert len(calls) == 3


def test_other_settings_are_refused(start, tmp_path, fails):
    out = tmp_path / "run"
    assert main(command(start, out, "--rounds", 1)) == 0
    before = (out / "category.npz").read_bytes()
    clip = write_clip(tmp_path / "clip")
    for more, words in (
        (("--data-seed", 1), f"clips must be the same to resume {out}"),
        (("--clips", clip), f"clips must be the same to resume {out}"),
        (("--rounds", 2), f"rounds must be 1 to resume {out}, whose encoder was trained, got 2"),
    ):
        assert fails(*command(start, out, "--rounds", 1, *more)).startswith(words)
    learnt = out / "category.npz"
    assert fails(*command(learnt, out, "--rounds", 1)).startswith(
        f"category must be the same to resume {out}"
    )
    assert learnt.read_bytes() == before


def test_clips_are_read_from_folders(start, tmp_path, capsys):
    out = tmp_path / "run"
    clips = [write_clip(tmp_path / "one", ("a", "b", "c")), write_clip(tmp_path / "two")]
    assert main(command(start, out, "--rounds", 1, "--images", 4, "--clips", *clips)) == 0
    assert f"{out / 'category.npz'}: images: 4, rounds: 1" in capsys.readouterr().out


def test_features_are_learnt_from_folders(start, tmp_path, fails):
    out = tmp_path / "run"
    clip, other = write_clip(tmp_path / "clip", channels=2), write_clip(tmp_path / "other")
    for clips, words in (
        ([clip, other], "images must all have the same number of features, or all have none, got"),
        ([write_clip(tmp_path / "odd", ("a", "b", "c"), 2)], "images and features of a clip must"),
        ([write_clip(tmp_path / "none", channels=2)], "clips must contain .npz, got none in"),
    ):
        for path in ("odd/features/b.npz", "none/features/a.npz", "none/features/b.npz"):
            (tmp_path / path).unlink(missing_ok=True)
        assert fails(*command(start, out, "--clips", *clips)).startswith(words)
        assert not out.exists()
    assert main(command(start, out, "--images", 2, "--clips", clip)) == 0
    learnt = Category.load(out / "category.npz")
    assert learnt.card["rounds"] == 2
    assert learnt.features.shape[1] == len(learnt.feature_noise) == 2
    assert encoder_of(learnt).dim > 0
    # Checksums of clips include features.
    grid = np.ones((4, 6, 2))
    np.savez(clip / "features" / "a.npz", grid)
    again = command(start, out, "--images", 2, "--clips", clip)
    assert fails(*again).startswith(f"clips must be the same to resume {out}")
    more = write_clip(tmp_path / "more", channels=3)
    message = fails(*command(out / "category.npz", tmp_path / "next", "--clips", more))
    assert message.startswith("features must have 2 channels for the category run, got 3")


def test_wrong_folders_give_one_error_line_and_no_files(start, tmp_path, fails):
    out, clip = tmp_path / "out", write_clip(tmp_path / "clip")
    cases = {}
    (tmp_path / "empty").mkdir()
    cases["empty"] = f"clips must be folders with images and masks, got no {tmp_path}/empty/images"
    (tmp_path / "blank" / "images").mkdir(parents=True)
    blank = tmp_path / "blank" / "images"
    cases["blank"] = f"clips must contain .jpeg or .jpg or .png, got none in {blank}"
    unmasked = write_clip(tmp_path / "unmasked")
    for mask in (unmasked / "masks").iterdir():
        mask.unlink()
    cases["unmasked"] = f"clips must contain .png, got none in {unmasked}/masks"
    (write_clip(tmp_path / "odd", ("a", "b")) / "masks" / "b.png").unlink()
    cases["odd"] = "images and masks of a clip must have the same names, got b in only one"
    twice = write_clip(tmp_path / "twice")
    Image.new("RGB", (60, 40)).save(twice / "images" / "a.jpg")
    cases["twice"] = f"images of a clip must have unique names, got two in {twice}/images"
    damaged = write_clip(tmp_path / "damaged") / "images" / "a.png"
    damaged.write_bytes(damaged.read_bytes()[:60])
    cases["damaged"] = f"{damaged}: expected an undamaged image"
    for name, words in cases.items():
        message = fails(*command(start, out, "--clips", clip, tmp_path / name, "--images", 4))
        assert message.startswith(words), name
        assert not out.exists()
    for more, words in (
        (("--images", 0), "images must be an integer of at least 1, got 0"),
        (("--rounds", 0), "rounds must be an integer of at least 1, got 0"),
        (("--data-seed", -1), "data_seed must be an integer of at least 0, got -1"),
    ):
        assert fails(*command(start, out, *more)).startswith(words)
    assert fails(*command("dragon", out)).startswith("category must be a file or one of ")
    assert not out.exists()

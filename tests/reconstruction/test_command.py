"""The command ``probmotion reconstruct``: what it reads, prints and refuses."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("torch")
from probmotion.cli.main import main


@pytest.fixture
def asked(monkeypatch, make_result):
    """Questions to an inference that answers each with a made reconstruction."""
    questions = []

    def reconstruct(observation, category, *, draws, seed):
        questions.append((observation, category, draws, seed))
        return make_result(observation.images)

    module = ModuleType("inference")
    module.reconstruct = reconstruct
    monkeypatch.setitem(sys.modules, "probmotion.reconstruction.inference", module)
    return questions


@pytest.fixture
def files(category, tmp_path):
    """Folder with a category without and one with features, two images, masks and features."""
    from probmotion.models.images.made_images import with_made_features

    category.save(tmp_path / "dog.npz")
    with_made_features(category, 3).save(tmp_path / "wolf.npz")
    inside = np.zeros((40, 60), dtype=np.uint8)
    inside[10:30, 15:45] = 255
    for number in range(2):
        Image.fromarray(np.stack([inside, inside // 2, inside], axis=-1)).save(
            tmp_path / f"image{number}.png"
        )
        Image.fromarray(inside).save(tmp_path / f"mask{number}.png")
        np.savez(tmp_path / f"features{number}.npz", np.ones((4, 6, 3), dtype=np.float32))
    return tmp_path


def run(files, capsys, *words, category="dog.npz"):
    """Run the command on files of a folder; return its status and its lines."""
    words = [*words, "--out", "out", "--category", category]
    paths = [str(files / word) if word == "out" or "." in word else word for word in words]
    status = main(["reconstruct", *paths])
    printed = capsys.readouterr()
    return status, printed.out + printed.err


def test_an_image_is_reconstructed(asked, files, capsys):
    words = ["image0.png", "--mask", "mask0.png", "--features", "features0.npz", "--fov", "60"]
    more = ["--draws", "7", "--seed", "3"]
    status, text = run(files, capsys, *words, *more, category="wolf.npz")
    assert status == 0, text
    ((observation, category, draws, seed),) = asked
    assert (observation.images, draws, seed, category.name) == (1, 7, 3, "quadruped")
    assert observation.features.shape[-1] == 3
    # The mask is half as wide as the image, and the crop 1.25 times as wide as the mask.
    assert observation.tangent[0] == pytest.approx(0.625 * np.tan(np.radians(30)), rel=0.02)
    assert "A body of the category quadruped explains the image." in text
    assert all((files / "out" / name).exists() for name in ("body.glb", "reconstruct.html"))


def test_a_clip_is_reconstructed(asked, files, capsys):
    words = ["image0.png", "image1.png", "--mask", "mask0.png", "mask1.png"]
    status, text = run(files, capsys, *words)
    assert status == 0, text
    assert asked[0][0].images == 2
    assert "explains the images." in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "image must contain at least one image"),
        (["image0.png"], "mask must be given, since the image has no transparency"),
        (["image0.png", "image1.png", "--mask", "mask0.png"], "mask must be a list of 2"),
        (["image0.png", "--mask", "mask0.png", "mask1.png"], "mask must be a single one"),
        (["image0.png", "--mask", "no.png"], "no.png"),
        (["image0.png", "--mask", "mask0.png", "--fov", "150"], "fov must be at most 120"),
        (["image0.png", "--mask", "mask0.png", "--seed", "-1"], "seed must be an integer of at"),
        (["image0.png"] * 11 + ["--mask"] + ["mask0.png"] * 11, "images must be at most 10"),
    ],
)
def test_errors_are_one_line_and_leave_no_files(asked, files, capsys, words, message):
    check_failure(files, message, *run(files, capsys, *words))
    assert asked == []


def test_unknown_categories_are_refused(asked, files, capsys):
    words = ["image0.png", "--mask", "mask0.png"]
    failure = run(files, capsys, *words, category="cat")
    check_failure(files, "category must be a file or", *failure)


def test_features_that_the_category_does_not_have_are_refused(asked, files, capsys):
    words = ["image0.png", "--mask", "mask0.png", "--features", "features0.npz"]
    message = "features must be left out for the category quadruped, got 3 channels; train"
    check_failure(files, message, *run(files, capsys, *words))
    assert asked == []


def test_features_change_the_reconstruction(files, capsys, monkeypatch):
    """With a network that was not trained, and one step of refinement."""
    pytest.importorskip("numba", reason="numba is not installed")
    from probmotion.models.images import encoder_training
    from probmotion.models.images.category import Category
    from probmotion.models.training.checkpoints import Checkpoint, save_checkpoint
    from probmotion.reconstruction import refinement

    monkeypatch.setattr(encoder_training, "_VALIDATED", 1)
    monkeypatch.setattr(refinement, "_STAGES", ((32, 1.0, 1),))
    trainee = encoder_training.EncoderTrainee(Category.load(files / "wolf.npz"))
    settings = {"network": dict(trainee.settings)}
    checkpoint = Checkpoint(trainee.kind, settings, trainee.network.state_dict())
    save_checkpoint(files / "wolf.safetensors", checkpoint)
    rng = np.random.default_rng(0)
    np.savez(files / "features1.npz", rng.standard_normal((4, 6, 3)))
    found = []
    for more in ([], ["--features", "features0.npz"], ["--features", "features1.npz"]):
        words = ["image0.png", "--mask", "mask0.png", "--draws", "2", *more]
        status, text = run(files, capsys, *words, category="wolf.npz")
        assert status == 0, text
        found.append(np.load(files / "out" / "reconstruction.npz")["theta"])
    assert all((found[k] != found[k - 1]).any() for k in range(3))


def check_failure(files, message, status, text):
    assert status == 2
    assert message in text
    assert len(text.splitlines()) == 1
    assert not (files / "out").exists()

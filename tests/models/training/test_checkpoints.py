"""Checkpoints: round trips, detection of damage and atomic writing."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from probmotion.cli.main import main
from probmotion.models.training import checkpoints
from probmotion.models.training.checkpoints import (
    WEIGHTS,
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)

ROOT = Path(__file__).parents[3]
KIND = "toy"
RNG = np.random.default_rng(0)
CHECKPOINT = Checkpoint(
    KIND,
    {"width": 4, "mean": [0.1, 1 / 3], "name": "größe", "deep": {"none": None}},
    {
        "weight": torch.tensor(RNG.normal(size=(3, 4)), dtype=torch.float32),
        "transposed": torch.tensor(RNG.normal(size=(4, 2)), dtype=torch.float32).T,
        "step": torch.tensor(7.0),
        "order": torch.tensor([2, 0, 1]),
        "mask": torch.tensor([True, False]),
    },
)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, CHECKPOINT)
    return path


def test_checkpoints_are_restored_bit_identically(path):
    loaded = load_checkpoint(path, KIND)
    assert (loaded.kind, loaded.settings) == (KIND, CHECKPOINT.settings)
    assert loaded.tensors.keys() == CHECKPOINT.tensors.keys()
    for name, tensor in CHECKPOINT.tensors.items():
        assert loaded.tensors[name].dtype == tensor.dtype
        assert torch.equal(loaded.tensors[name], tensor)
    # The file can be read by safetensors alone.
    with safe_open(path, framework="np") as file:
        header = json.loads(file.metadata()["probmotion"])
        np.testing.assert_array_equal(file.get_tensor("weight"), CHECKPOINT.tensors["weight"])
    assert (header["kind"], header["settings"]) == (KIND, CHECKPOINT.settings)


def test_half_precision_halves_the_file(tmp_path):
    """Half precision has 11 significant bits."""
    weight = torch.tensor(RNG.normal(size=(200, 200)), dtype=torch.float32)
    tensors = {"weight": weight, "order": torch.tensor([3, 1])}
    path = tmp_path / "half.safetensors"
    save_checkpoint(path, Checkpoint(KIND, {}, tensors), half=True)
    assert path.stat().st_size < 0.52 * weight.nbytes
    loaded = load_checkpoint(path, KIND).tensors
    torch.testing.assert_close(loaded["weight"], weight, rtol=2.0**-11, atol=1e-7)
    assert torch.equal(loaded["order"], tensors["order"])


def test_flipped_bits_are_detected_or_harmless(path):
    content = path.read_bytes()
    for index in range(0, len(content), 3):
        damaged = bytearray(content)
        damaged[index] ^= 1
        path.write_bytes(damaged)
        with suppress(CheckpointError):
            loaded = load_checkpoint(path, KIND)
            assert loaded.settings == CHECKPOINT.settings
            for name, tensor in CHECKPOINT.tensors.items():
                assert torch.equal(loaded.tensors[name], tensor)


@pytest.mark.parametrize("length", [0, 8, 100, -1, None])
def test_truncated_files_and_pickles_are_rejected(path, length):
    pickle = b"\x80\x04\x95 a pickle"
    path.write_bytes(pickle if length is None else path.read_bytes()[:length])
    with pytest.raises(CheckpointError, match="is damaged or not a safetensors file"):
        load_checkpoint(path, KIND)


def test_other_files_are_rejected(path, tmp_path):
    for missing in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(FileNotFoundError, match="source must be a file"):
            load_checkpoint(missing, KIND)
    with pytest.raises(CheckpointError, match="must contain a motion-diffusion, got a toy"):
        load_checkpoint(path, "motion-diffusion")
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["probmotion"])
    for metadata, message in (
        (json.dumps(header | {"format": 99}), "checkpoint of version 1, got version 99"),
        (json.dumps({"format": 99, "kind": "lifter"}), "must contain a toy, got a lifter"),
        (None, "must be a checkpoint of probmotion"),
        ("[1]", "must be a checkpoint of probmotion"),
    ):
        save_file({"a": torch.zeros(2)}, path, metadata=metadata and {"probmotion": metadata})
        with pytest.raises(CheckpointError, match=message):
            load_checkpoint(path, KIND)


def test_failed_writes_leave_the_previous_file(path, tmp_path, monkeypatch):
    before = path.read_bytes()
    for settings, value, half, message in (
        ({}, np.nan, False, "tensors must be finite, got NaN or infinity in a"),
        ({}, 1e6, True, "tensors must be finite, got NaN or infinity in a"),
        ({"rate": float("inf")}, 0.0, False, "settings must be JSON data"),
        ({"rate": np.zeros(2)}, 0.0, False, "settings must be JSON data"),
    ):
        checkpoint = Checkpoint(KIND, settings, {"a": torch.tensor([value])})
        with pytest.raises(ValueError, match=message):
            save_checkpoint(path, checkpoint, half=half)

    def interrupted(file, content):
        file.write_text("half", encoding="utf-8")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", interrupted)
        with pytest.raises(KeyboardInterrupt):
            save_checkpoint(path, CHECKPOINT)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.safetensors"]
    with pytest.raises(OSError, match="nowhere"):
        save_checkpoint(tmp_path / "nowhere" / "a.safetensors", CHECKPOINT)


def test_files_of_other_versions_name_the_command_that_trains_them_again(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    trained = re.findall(r"^  ([a-z-]+) ", capsys.readouterr().out, flags=re.MULTILINE)
    shipped = {checkpoints._kind(file) for file in WEIGHTS.glob("*.safetensors")}
    assert len(shipped) > 4
    for kind in shipped:
        path = tmp_path / "old.safetensors"
        header = json.dumps({"format": 0, "kind": kind})
        save_file({"a": torch.zeros(2)}, path, metadata={"probmotion": header})
        with pytest.raises(CheckpointError, match=r"got version 0; .* trained again: ") as refused:
            load_checkpoint(path, kind)
        with pytest.raises(CheckpointError, match=r"settings: Missing key.* trained again: "):
            load_weights(torch.nn.Linear(2, 2), {}, kind)
        *_, command = str(refused.value).rpartition("again: ")
        name = command.removeprefix("probmotion train ")
        assert name in trained or (ROOT / command.split()[1]).is_file()
        save_file({"a": torch.zeros(2)}, path, metadata={"probmotion": json.dumps({"kind": kind})})
        with pytest.raises(CheckpointError, match=r"got no header; .* trained again: "):
            load_checkpoint(path, kind)

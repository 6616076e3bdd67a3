"""Checkpoints: what comes back, and that no damage goes unnoticed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from probmotion.models.training.checkpoints import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
)

KIND = "toy"


@pytest.fixture
def checkpoint():
    rng = np.random.default_rng(0)
    tensors = {
        "weight": torch.tensor(rng.normal(size=(3, 4)), dtype=torch.float32),
        "turned": torch.tensor(rng.normal(size=(4, 2)), dtype=torch.float32).T,
        "step": torch.tensor(7.0),
        "order": torch.tensor([2, 0, 1]),
        "kept": torch.tensor([True, False]),
    }
    settings = {"width": 4, "mean": [0.1, 1 / 3], "name": "größe", "deep": {"none": None}}
    return Checkpoint(KIND, settings, tensors)


def test_all_comes_back_bit_for_bit(tmp_path, checkpoint):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, checkpoint)
    got = load_checkpoint(path, KIND)
    assert got.kind == KIND
    assert got.settings == checkpoint.settings
    assert got.tensors.keys() == checkpoint.tensors.keys()
    for name, tensor in checkpoint.tensors.items():
        assert got.tensors[name].dtype == tensor.dtype
        assert torch.equal(got.tensors[name], tensor)


def test_the_file_is_that_of_safetensors_alone(tmp_path, checkpoint):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, checkpoint)
    with safe_open(path, framework="np") as file:
        header = json.loads(file.metadata()["probmotion"])
        np.testing.assert_array_equal(file.get_tensor("weight"), checkpoint.tensors["weight"])
    assert header["kind"] == KIND
    assert header["settings"] == checkpoint.settings


def test_half_precision_halves_the_file_and_keeps_three_digits(tmp_path):
    weight = torch.tensor(np.random.default_rng(0).normal(size=(200, 200)), dtype=torch.float32)
    whole = Checkpoint(KIND, {}, {"weight": weight, "order": torch.tensor([3, 1])})
    save_checkpoint(tmp_path / "whole.safetensors", whole)
    save_checkpoint(tmp_path / "half.safetensors", whole, half=True)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.52 * sizes[0]
    got = load_checkpoint(tmp_path / "half.safetensors", KIND).tensors
    assert got["weight"].dtype == torch.float32
    # Half precision rounds to 11 bits.
    torch.testing.assert_close(got["weight"], weight, rtol=2.0**-11, atol=1e-7)
    assert not torch.equal(got["weight"], weight)
    assert torch.equal(got["order"], whole.tensors["order"])


def test_no_flipped_bit_goes_unnoticed(tmp_path, checkpoint):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, checkpoint)
    sound = path.read_bytes()
    missed = []
    for place in range(len(sound)):
        damaged = bytearray(sound)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        try:
            got = load_checkpoint(path, KIND)
        except CheckpointError as error:
            assert "\n" not in str(error)  # noqa: PT017 (one of hundreds of places)
            continue
        same = got.settings == checkpoint.settings and all(
            torch.equal(got.tensors[name], tensor) for name, tensor in checkpoint.tensors.items()
        )
        if not same:
            missed.append(place)
    assert missed == []


def test_a_file_cut_short_is_refused(tmp_path, checkpoint):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, checkpoint)
    sound = path.read_bytes()
    for length in (0, 4, 8, 100, len(sound) // 2, len(sound) - 1):
        path.write_bytes(sound[:length])
        with pytest.raises(CheckpointError, match="is damaged or no safetensors file"):
            load_checkpoint(path, KIND)


def test_what_is_something_else_is_said_in_a_sentence(tmp_path, checkpoint):
    path = tmp_path / "a.safetensors"
    with pytest.raises(FileNotFoundError, match="there is no checkpoint"):
        load_checkpoint(path, KIND)
    with pytest.raises(FileNotFoundError, match="there is no checkpoint"):
        load_checkpoint(tmp_path, KIND)
    save_checkpoint(path, checkpoint)
    with pytest.raises(CheckpointError, match="holds a toy, expected a motion-diffusion"):
        load_checkpoint(path, "motion-diffusion")
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["probmotion"])
    header["format"] = 99
    save_file({"a": torch.zeros(2)}, path, metadata={"probmotion": json.dumps(header)})
    with pytest.raises(CheckpointError, match="is a checkpoint of version 99, expected version 1"):
        load_checkpoint(path, KIND)
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(CheckpointError, match="holds tensors of another program"):
        load_checkpoint(path, KIND)
    save_file({"a": torch.zeros(2)}, path, metadata={"probmotion": "[1]"})
    with pytest.raises(CheckpointError, match="holds tensors of another program"):
        load_checkpoint(path, KIND)
    path.write_bytes(b"\x80\x04\x95 a pickle, which could run code")
    with pytest.raises(CheckpointError, match="is damaged or no safetensors file"):
        load_checkpoint(path, KIND)


def test_nothing_half_written_is_left(tmp_path, checkpoint, monkeypatch):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, checkpoint)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="tensors has a, which is not finite"):
        save_checkpoint(path, Checkpoint(KIND, {}, {"a": torch.tensor([1.0, np.nan])}))
    for wrong in (float("inf"), np.zeros(2)):
        with pytest.raises(ValueError, match="settings is no JSON, expected what JSON can hold"):
            save_checkpoint(path, Checkpoint(KIND, {"rate": wrong}, {}))
    with pytest.raises(ValueError, match="tensors has a, which is not finite"):
        save_checkpoint(path, Checkpoint(KIND, {}, {"a": torch.tensor([1e6])}), half=True)

    def interrupted(file, content):
        file.write_text("half", encoding="utf-8")
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, checkpoint)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.safetensors"]
    monkeypatch.undo()
    with pytest.raises(OSError, match=r"cannot write .*: .*; expected a folder that is writable"):
        save_checkpoint(tmp_path / "nowhere" / "a.safetensors", checkpoint)

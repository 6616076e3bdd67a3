"""Checkpoints of networks: safetensors files with a JSON header.

Loading such a file cannot execute code. The header's ``probmotion`` entry contains the format
version, the kind of network, its settings and the SHA-256 of settings and tensors.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from probmotion.extras import nn, torch
from probmotion.files import written_whole

__all__ = [
    "MODEL",
    "WEIGHTS",
    "Checkpoint",
    "CheckpointError",
    "load_checkpoint",
    "load_weights",
    "save_checkpoint",
    "valid_settings",
    "weights_digest",
]

MODEL = "model.safetensors"
"""File name of the checkpoint in the folder of a training run."""

WEIGHTS = Path(__file__).parents[1] / "weights"
"""Folder of the networks shipped with the package."""
_FORMAT = 1  # version of the format
_TRAIN = {
    "motion-diffusion": "probmotion train diffusion",
    "track-evaluator": "probmotion train evaluator",
    "pose-flow": "probmotion train lifter",
    "pose-lifter": "probmotion train lifter",
    "motion-dvae": "probmotion train dvae",
    "motion-denoiser": "probmotion train denoiser",
    "motion-vae": "probmotion train motion-vae",
    "motion-vae-poses": "probmotion train motion-vae",
    "motion-vae-encoder": "probmotion train motion-vae",
    "image-encoder": "probmotion train images",
    "joint-corrector": "python notebooks/ship_joint_corrector.py --data DATA --pairs DIR",
}  # command that trains a kind of network
_ENTRY = "probmotion"  # key of the header's metadata


class CheckpointError(ValueError):
    """Error for a file that is not a checkpoint, is damaged or has another kind of network."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Checkpoint of a network: its kind, JSON settings (size, training record) and weights."""

    kind: str
    settings: Mapping[str, Any]
    tensors: Mapping[str, torch.Tensor]


def save_checkpoint(path: str | Path, checkpoint: Checkpoint, *, half: bool = False) -> None:
    """Write a checkpoint atomically; ``half`` stores tensors in half precision.

    Raises
    ------
    ValueError
        If a tensor is not finite, or the settings are not JSON.
    OSError
        If the file cannot be written.
    """
    tensors = {}
    for name, tensor in checkpoint.tensors.items():
        stored = tensor.detach().cpu().contiguous()
        if stored.is_floating_point():
            stored = stored.half() if half else stored
            if not torch.isfinite(stored).all():
                raise ValueError(f"tensors must be finite, got NaN or infinity in {name}")
        tensors[name] = stored
    try:
        settings = json.loads(json.dumps(checkpoint.settings, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"settings must be JSON data: {error}") from error
    header = {
        "format": _FORMAT,
        "kind": checkpoint.kind,
        "settings": settings,
        "sha256": _digest(settings, tensors),
    }
    from safetensors.torch import save

    with written_whole(Path(path)) as unfinished:
        unfinished.write_bytes(save(tensors, metadata={_ENTRY: json.dumps(header)}))


def load_checkpoint(source: str | Path, kind: str) -> Checkpoint:
    """Return a checkpoint, with half-precision tensors converted to single precision.

    Parameters
    ----------
    source : str or Path
        A file, the folder of a training run, or the name of a network shipped with the package.
    kind : str
        Expected kind of network.

    Raises
    ------
    CheckpointError
        If the file is not a checkpoint, is damaged, or has another version or kind.
    FileNotFoundError
        If there is no such file, folder or name.
    """
    from safetensors.torch import load

    path = _find(source, kind)
    try:
        content = path.read_bytes()
        # safe_open with the framework "pt" would take Ctrl-C for a damaged file.
        tensors = load(content)
        size = int.from_bytes(content[:8], "little")
        text = json.loads(content[8 : 8 + size]).get("__metadata__", {}).get(_ENTRY)
        header = None if text is None else json.loads(text)
    except (
        SafetensorError, ValueError, KeyError, TypeError, RuntimeError, RecursionError, OSError,
    ) as error:  # fmt: skip
        raise CheckpointError(f"{path} is damaged or not a safetensors file: {error}") from error
    if not isinstance(header, dict) or "format" not in header:
        raise CheckpointError(
            f"{path} must be a checkpoint of probmotion, got no header{_train_again(kind)}"
        )
    if header.get("kind") != kind:
        raise CheckpointError(f"{path} must contain a {kind}, got a {header.get('kind')}")
    if header["format"] != _FORMAT:
        raise CheckpointError(
            f"{path} must be a checkpoint of version {_FORMAT}, got version {header['format']}"
            f"{_train_again(kind)}"
        )
    settings = header.get("settings", {})
    if header.get("sha256") != _digest(settings, tensors):
        raise CheckpointError(f"{path} is damaged: the checksum does not match")
    for name, tensor in tensors.items():
        if tensor.dtype == torch.float16:
            tensors[name] = tensor.float()
    return Checkpoint(kind, settings, tensors)


@contextmanager
def valid_settings(source: str | Path, kind: str) -> Iterator[None]:
    """Convert errors due to missing or invalid settings of a network to ``CheckpointError``."""
    try:
        yield
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{source} must contain valid {kind} settings, got an error: {error}"
            f"{_train_again(kind)}"
        ) from error


def load_weights(network: nn.Module, tensors: Mapping[str, torch.Tensor], kind: str) -> None:
    """Load tensors into a network; raise ``CheckpointError`` if names or shapes differ."""
    try:
        network.load_state_dict(dict(tensors))
    except RuntimeError as error:
        detail = " ".join(str(error).split("\n\t")[1:2])
        raise CheckpointError(
            f"weights must match the checkpoint's settings: {detail}{_train_again(kind)}"
        ) from error


def weights_digest(network: nn.Module) -> str:
    """Return the SHA-256 of a network's weights in half precision."""
    tensors = {
        name: tensor.detach().cpu().half() if tensor.is_floating_point() else tensor.cpu()
        for name, tensor in network.state_dict().items()
    }
    return _digest({}, tensors)


def _train_again(kind: str) -> str:
    command = _TRAIN.get(kind)
    return f"; files of other versions must be trained again: {command}" if command else ""


def _find(source: str | Path, kind: str) -> Path:
    path = Path(source)
    if path.is_dir():
        path = path / MODEL
    if path.is_file():
        return path
    shipped = WEIGHTS / f"{source}.safetensors"
    if isinstance(source, str) and shipped.is_file():
        return shipped
    known = [file.stem for file in sorted(WEIGHTS.glob("*.safetensors")) if _kind(file) == kind]
    names = f", the folder of a training run or one of {', '.join(known)}" if known else ""
    names = names or " or the folder of a training run"
    raise FileNotFoundError(f"source must be a file{names}, got {str(source)!r}")


def _kind(path: Path) -> str:
    with safe_open(path, framework="numpy") as file:
        return str(json.loads(file.metadata()[_ENTRY])["kind"])


def _digest(settings: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()

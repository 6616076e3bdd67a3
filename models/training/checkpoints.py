"""Networks in files: one safetensors file whose header holds a JSON of what rebuilds it.

Nothing in such a file can run code. The header's ``probmotion`` entry says the format's version,
the kind of network, its settings and the SHA-256 of settings and tensors.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from probmotion.files import written_whole

__all__ = [
    "MODEL",
    "WEIGHTS",
    "Checkpoint",
    "CheckpointError",
    "load_checkpoint",
    "load_weights",
    "save_checkpoint",
    "weights_digest",
]

MODEL = "model.safetensors"
"""The checkpoint in the folder of a training run."""

WEIGHTS = Path(__file__).parents[1] / "weights"
"""Where networks that come with the package lie."""
_FORMAT = 1
_ENTRY = "probmotion"


class CheckpointError(ValueError):
    """A file is no checkpoint, is damaged, or is of another kind; the message says which."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a checkpoint's file holds.

    Parameters
    ----------
    kind : str
        Of the network: ``"motion-diffusion"``, …
    settings : mapping
        JSON: all that rebuilds the network, and how it was trained.
    tensors : mapping of str to Tensor
        The weights.
    """

    kind: str
    settings: Mapping[str, Any]
    tensors: Mapping[str, torch.Tensor]


def save_checkpoint(path: str | Path, checkpoint: Checkpoint, *, half: bool = False) -> None:
    """Write a checkpoint, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file, ``.safetensors``.
    checkpoint : Checkpoint
        What to write.
    half : bool
        Store floating-point tensors in half precision: half the size, three digits.

    Raises
    ------
    ValueError
        If a tensor is not finite, or the settings are no JSON.
    OSError
        If the file cannot be written.
    """
    tensors = {}
    for name, tensor in checkpoint.tensors.items():
        kept = tensor.detach().cpu().contiguous()
        if kept.is_floating_point():
            if half:
                kept = kept.half()
            if not torch.isfinite(kept).all():
                raise ValueError(
                    f"tensors has {name}, which is not finite, expected finite weights"
                )
        tensors[name] = kept
    try:
        settings = json.loads(json.dumps(checkpoint.settings, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"settings is no JSON, expected what JSON can hold: {error}") from error
    header = {
        "format": _FORMAT,
        "kind": checkpoint.kind,
        "settings": settings,
        "sha256": _digest(settings, tensors),
    }
    with written_whole(Path(path)) as unfinished:
        unfinished.write_bytes(save(tensors, metadata={_ENTRY: json.dumps(header)}))


def load_checkpoint(source: str | Path, kind: str) -> Checkpoint:
    """Return what a checkpoint's file holds; half-precision tensors come back in single.

    Parameters
    ----------
    source : str or Path
        The file, the folder of a training run, or the name of a network that comes with the
        package.
    kind : str
        The kind of network that is expected.

    Raises
    ------
    CheckpointError
        If the file is no checkpoint, is damaged, of another version or of another kind.
    FileNotFoundError
        If there is no such file, folder or name.
    """
    path = _find(source, kind)
    try:
        with safe_open(path, framework="pt") as file:
            words = (file.metadata() or {}).get(_ENTRY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        header = json.loads(words) if words is not None else None
    except (SafetensorError, json.JSONDecodeError, OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path} is damaged or no safetensors file: {error}") from error
    if not isinstance(header, dict) or "format" not in header:
        raise CheckpointError(f"{path} holds tensors of another program, expected a checkpoint")
    if header["format"] != _FORMAT:
        raise CheckpointError(
            f"{path} is a checkpoint of version {header['format']}, expected version {_FORMAT}"
        )
    if header.get("kind") != kind:
        raise CheckpointError(f"{path} holds a {header.get('kind')}, expected a {kind}")
    settings = header.get("settings", {})
    if header.get("sha256") != _digest(settings, tensors):
        raise CheckpointError(f"{path} is damaged: it does not hold what was written")
    single = {
        name: tensor.float() if tensor.dtype == torch.float16 else tensor
        for name, tensor in tensors.items()
    }
    return Checkpoint(kind, settings, single)


def load_weights(network: nn.Module, tensors: Mapping[str, torch.Tensor]) -> None:
    """Put a checkpoint's tensors into a network.

    Raises
    ------
    CheckpointError
        If the network has other weights: the checkpoint's settings are not those of its tensors.
    """
    try:
        network.load_state_dict(dict(tensors))
    except RuntimeError as error:
        raise CheckpointError(
            "the checkpoint holds weights of another network than its settings say"
        ) from error


def weights_digest(network: nn.Module) -> str:
    """Return what tells a network's weights from others', the same for half-precision copies."""
    tensors = {
        name: tensor.detach().cpu().half() if tensor.is_floating_point() else tensor.cpu()
        for name, tensor in network.state_dict().items()
    }
    return _digest({}, tensors)


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
    raise FileNotFoundError(
        f"there is no checkpoint {path}, expected a file, the folder of a training run or one of "
        f"{', '.join(known) or 'no names'}"
    )


def _kind(path: Path) -> str:
    with safe_open(path, framework="pt") as file:
        return str(json.loads(file.metadata()[_ENTRY])["kind"])


def _digest(settings: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> str:
    found = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        found.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        found.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return found.hexdigest()

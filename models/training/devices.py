"""Devices and precision of networks.

Random numbers are drawn on the CPU, so that they do not depend on the device; only dropout draws on
the device. Weights, inputs and outputs of networks are in single precision on every device.
Training on CUDA computes matrix products in bfloat16.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from probmotion import seeds
from probmotion.extras import torch

__all__ = [
    "batch_tokens",
    "check_device",
    "dropout_seed",
    "half_precision",
    "inference",
    "is_half_precision",
]

_GPU_TOKENS = 200_000  # of a batch, for 8 GiB at the published size


def check_device(device: str) -> torch.device:
    """Return the device of a name; ``auto`` is ``cuda`` where it is available, else ``cpu``.

    Raises ``ValueError`` for another name, and for ``cuda`` where it is not available.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device must be auto, cpu or cuda, got {device!r}")
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise ValueError("device must be cpu, got cuda, which is not available")
    return torch.device("cuda" if available and device != "cpu" else "cpu")


def batch_tokens(device: str, on_cpu: int) -> int:
    """Return the number of tokens of a batch: large on a GPU, which small batches leave idle."""
    return on_cpu if device == "cpu" else _GPU_TOKENS


def half_precision(device: torch.device, enabled: bool) -> AbstractContextManager[object]:
    """Return a context with matrix products in bfloat16, or in the tensors' precision."""
    # The device meta, on which tests trace shapes, has no autocast.
    if not torch.amp.is_autocast_available(device.type):
        return nullcontext()
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


def is_half_precision(device: torch.device) -> bool:
    """Return whether :func:`half_precision` is enabled."""
    available = torch.amp.is_autocast_available(device.type)
    return available and torch.is_autocast_enabled(device.type)


@contextmanager
def inference(device: str) -> Iterator[None]:
    """Disable gradients and, on CUDA, torch's fused transformer layers.

    The fused layers round matrix products to TF32, whatever torch's settings: errors of 1e-3.
    """
    enabled = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(enabled and device == "cpu")
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.backends.mha.set_fastpath_enabled(enabled)


@contextmanager
def dropout_seed(seed: int, step: int, device: torch.device) -> Iterator[None]:
    """Seed torch's global generators, which dropout uses, for one step; then restore them."""
    devices = [torch.cuda.current_device()] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seeds.integer(seed, "dropout", step))
        yield

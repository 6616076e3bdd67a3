"""Priors: what one believes about motion. No module here imports a sampler."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from probmotion.models.gaussian_mixture import GaussianMixtureMotion
    from probmotion.models.motion_diffusion import MotionDiffusion
    from probmotion.models.motion_dvae import MotionDVAE
    from probmotion.models.motion_vae import MotionVAE

_HOMES = {
    "GaussianMixtureMotion": "gaussian_mixture",
    "MotionDVAE": "motion_dvae",
    "MotionDiffusion": "motion_diffusion",
    "MotionVAE": "motion_vae",
}

__all__ = ["GaussianMixtureMotion", "MotionDVAE", "MotionDiffusion", "MotionVAE"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"probmotion.models.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'probmotion.models' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])

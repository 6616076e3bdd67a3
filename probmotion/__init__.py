"""Sampling from posterior distributions over 3D skeletal motion."""

from typing import Any

import lazy_loader

__version__ = "0.1.0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Former names of modules; to be removed in 0.2.
_RENAMED = {
    "load_motion": "load", "load_motions": "load_all", "save_motion": "save",
    "advice": "comparison", "bias": "calibration", "checks": "validation",
    "diffusion": "posteriors.noise_schedule", "draws": "posteriors.draws", "formats": "io",
    "cameras": "geometry.cameras", "kinematics": "motion.kinematics",
    "likelihoods": "posteriors.likelihoods", "noisy_joints": "posteriors.noisy_joints",
    "pictures": "plots", "resampling": "motion.resampling", "priors": "posteriors.protocols",
    "retargeting": "motion.retargeting", "rotations": "geometry.rotations",
    "sampling": "posteriors.sampling", "skeleton": "motion.skeleton",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        raise AttributeError(f"probmotion.{name} is now probmotion.{_RENAMED[name]}")
    return _load(name)

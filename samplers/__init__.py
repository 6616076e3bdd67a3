"""Samplers: how to draw. One file per method; none imports a model."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from probmotion.samplers.ancestral3d import Ancestral3D
    from probmotion.samplers.dvae import DVAEInference
    from probmotion.samplers.ensemble import Ensemble
    from probmotion.samplers.exact import ExactSampler
    from probmotion.samplers.mas import MultiViewAncestral
    from probmotion.samplers.metropolis import MetropolisHastings
    from probmotion.samplers.mvpc import MultiViewPredictorCorrector
    from probmotion.samplers.nuts import NUTS
    from probmotion.samplers.sds import ScoreDistillation

_HOMES = {
    "NUTS": "nuts",
    "Ancestral3D": "ancestral3d",
    "DVAEInference": "dvae",
    "Ensemble": "ensemble",
    "ExactSampler": "exact",
    "MetropolisHastings": "metropolis",
    "MultiViewAncestral": "mas",
    "MultiViewPredictorCorrector": "mvpc",
    "ScoreDistillation": "sds",
}

__all__ = [
    "NUTS",
    "Ancestral3D",
    "DVAEInference",
    "Ensemble",
    "ExactSampler",
    "MetropolisHastings",
    "MultiViewAncestral",
    "MultiViewPredictorCorrector",
    "ScoreDistillation",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"probmotion.samplers.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'probmotion.samplers' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])

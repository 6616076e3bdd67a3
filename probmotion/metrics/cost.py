"""What did the draws cost?"""

from __future__ import annotations

from probmotion.posteriors.draws import MotionDraws

__all__ = ["costs"]


def costs(draws: MotionDraws) -> dict[str, float]:
    """Return wall-clock ``seconds`` and ``<kind>_evaluations`` of a run.

    Each evaluation is of one motion (one view of one motion for a 2D denoiser).
    """
    found = {"seconds": draws.seconds}
    for kind, count in draws.counts.items():
        found[f"{kind}_evaluations"] = float(count)
    return found

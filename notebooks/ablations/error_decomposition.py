"""Decomposition of the error of MAS on problems with exact draws.

    python notebooks/ablations/error_decomposition.py --out budgets
    python notebooks/ablations/error_decomposition.py --quick --out quick  (short motions, 2 min)

``--settings`` selects settings; each writes a table and a figure. Results are stored in ``--out``,
and an interrupted study continues from there. The setting ``network`` trains a denoiser on 2D
views of the problem's own prior.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from probmotion.calibration.error_decomposition import decompose_error
from probmotion.calibration.error_result import ErrorDecomposition
from probmotion.data.projections import Filming
from probmotion.files import written_whole
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.projected_denoiser import denoiser_of
from probmotion.models.training.settings import TrainingSettings
from probmotion.posteriors.problem import Problem
from probmotion.problems import load_problem


@dataclass(frozen=True)
class Setting:
    """A problem and the settings of MAS; ``network`` trains a denoiser for it."""

    problem: str = "gait"
    steps: int = 100
    settings: dict[str, Any] = field(default_factory=dict)
    shared_noise: bool | None = None
    network: bool = False


SETTINGS = {
    "gait": Setting(),
    "fewer steps": Setting(steps=30),
    "12 views": Setting(settings={"n_views": 12}),
    "tilted views": Setting(settings={"elevation": np.pi / 6}),
    "network": Setting(shared_noise=True, network=True),
    "monocular": Setting("gait-monocular"),
    "occluded": Setting("gait-occluded"),
}


@dataclass(frozen=True)
class Study:
    """Sizes of the study and its output folder."""

    out: Path
    quick: bool

    def budget(self, name: str) -> ErrorDecomposition:
        """Return a setting's error decomposition; write its table and figure."""
        asked = SETTINGS[name]
        scale = {"frames": 6, "components": 12} if self.quick else {}
        problem = load_problem(asked.problem, **scale)
        folder = self.out / name.replace(" ", "-")
        budget = decompose_error(
            problem,
            steps=asked.steps // (10 if self.quick else 1),
            seeds=2 if self.quick else 5,
            draws=30 if self.quick else 200,
            settings=asked.settings,
            shared_noise=asked.shared_noise,
            learnt=self.network(problem, folder / "network") if asked.network else None,
            out=folder,
        )
        budget.plot(folder / "decompose_error.png")
        return budget

    def network(self, problem: Problem, folder: Path) -> MotionDiffusion:
        """Return a 2D denoiser trained on views of the problem's prior."""
        # As the exact denoiser sees them: orthographic, level, centred on average.
        filming = Filming(tilt=0.0, perspective=False, centre="sequence")
        steps = 60 if self.quick else 4000
        return denoiser_of(
            problem.posterior.prior,
            folder,
            size="tiny" if self.quick else "small",
            motions=40 if self.quick else 4000,
            views=4,
            filming=filming,
            training=TrainingSettings(steps=steps, learning_rate=1e-3),
        )


def main() -> None:
    """Run the selected settings and write one table of all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="short motions, few draws")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    asked = parser.parse_args()
    study = Study(asked.out, asked.quick)
    asked.out.mkdir(parents=True, exist_ok=True)
    tables = []
    for name in asked.settings:
        budget = study.budget(name)
        tables.append(budget.table().assign(setting=f"{name}: {budget.setting}"))
        print(f"\n{budget.setting} ({name})", *budget.findings, *budget.notes, sep="\n", flush=True)
    with written_whole(asked.out / "bias_budgets.csv") as path:
        pd.concat(tables).to_csv(path, index=False)


if __name__ == "__main__":
    main()

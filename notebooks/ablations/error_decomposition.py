"""Decomposition of the error of MAS on problems with exact draws.

    python notebooks/ablations/error_decomposition.py --out budgets
    python notebooks/ablations/error_decomposition.py --quick --out quick  (short motions, 2 min)

Each of the ``--settings`` writes a table and a figure. Results are stored in ``--out``; run the
same command again to resume an interrupted study. The setting ``network`` trains a denoiser on 2D
views of draws from the prior of the problem.
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
    """Problem and settings of MAS; with ``network``, a denoiser is trained for the problem."""

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
    """Output folder and size of the study."""

    out: Path
    quick: bool

    def decomposition(self, name: str) -> ErrorDecomposition:
        """Return the error decomposition of a setting; write its table and figure."""
        setting = SETTINGS[name]
        scale = {"frames": 6, "components": 12} if self.quick else {}
        problem = load_problem(setting.problem, **scale)
        folder = self.out / name.replace(" ", "-")
        decomposition = decompose_error(
            problem,
            steps=setting.steps // (10 if self.quick else 1),
            seeds=2 if self.quick else 5,
            draws=30 if self.quick else 200,
            settings=setting.settings,
            shared_noise=setting.shared_noise,
            learnt=self.network(problem, folder / "network") if setting.network else None,
            out=folder,
        )
        decomposition.plot(folder / "decompose_error.png")
        return decomposition

    def network(self, problem: Problem, folder: Path) -> MotionDiffusion:
        """Return a 2D denoiser trained on views of draws from the prior of the problem."""
        # Use the projection of the exact denoiser: orthographic, level, centred on average.
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
    """Run the selected settings and write one table of all results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="Output folder.")
    parser.add_argument("--quick", action="store_true", help="Short motions and few draws.")
    names = list(SETTINGS)
    parser.add_argument(
        "--settings", nargs="+", choices=names, default=names, help="Settings to run."
    )
    options = parser.parse_args()
    study = Study(options.out, options.quick)
    options.out.mkdir(parents=True, exist_ok=True)
    tables = []
    for name in options.settings:
        result = study.decomposition(name)
        tables.append(result.table().assign(setting=f"{name}: {result.setting}"))
        print(f"\n{result.setting} ({name})", *result.findings, *result.notes, sep="\n", flush=True)
    with written_whole(options.out / "bias_budgets.csv") as path:
        pd.concat(tables).to_csv(path, index=False)


if __name__ == "__main__":
    main()

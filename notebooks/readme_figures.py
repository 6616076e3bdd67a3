"""Draw the README's figures from a finished ``make demo``.

python notebooks/readme_figures.py            # reads demo/, writes notebooks/pictures/
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from probmotion import Comparison
from probmotion.plots.skeletons import draw_skeletons
from probmotion.plots.spread import plot_spread
from probmotion.problems import load_problem

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "notebooks" / "pictures"
SHOWN = ("exact", "nuts", "mh", "mas")


def save_small(path: Path) -> None:
    """Reduce an image to few colours, so that the repository stays small."""
    image = Image.open(path).convert("RGB")
    small = image.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def main() -> None:
    """Draw the figures."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    comparison = Comparison.load(ROOT / "demo")
    problem = load_problem("gait-monocular")
    rows = {name: comparison.draws(problem.name, name).flat()[5::10] for name in SHOWN}
    skeletons, quality = FIGURES / "gait-monocular.png", FIGURES / "quality_against_cost.png"
    spread = FIGURES / "spread.png"
    comparison.plot(quality)
    draw_skeletons(
        rows, problem.posterior.skeleton, skeletons, azimuth=np.pi / 2, truth=problem.truth
    )
    plot_spread(
        {name: comparison.draws(problem.name, name).flat() for name in SHOWN},
        problem.posterior.skeleton, spread, azimuth=np.pi / 2, truth=problem.truth,
    )  # fmt: skip
    for path in (skeletons, quality, spread):
        save_small(path)


if __name__ == "__main__":
    main()

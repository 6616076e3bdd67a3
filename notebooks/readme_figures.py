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
from probmotion.problems import load_problem

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "notebooks" / "pictures"
SHOWN = ("exact", "mas", "mvpc", "nuts")


def save_small(path: Path) -> None:
    """Reduce an image to few colours, so that the repository stays small."""
    image = Image.open(path).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """Draw the figures."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    comparison = Comparison.load(ROOT / "demo")
    problem = load_problem("gait-monocular")
    rows = {name: comparison.draws(problem.name, name).flat()[5::10] for name in SHOWN}
    skeletons, quality = FIGURES / "gait-monocular.png", FIGURES / "quality_against_cost.png"
    comparison.plot(quality)
    draw_skeletons(
        rows, problem.posterior.skeleton, skeletons, azimuth=np.pi / 2, truth=problem.truth
    )
    for path in (skeletons, quality):
        save_small(path)


if __name__ == "__main__":
    main()

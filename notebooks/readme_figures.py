"""Put the figures of a finished ``make demo`` into the README: its table and its pictures.

python notebooks/readme_figures.py            # reads demo/, writes README.md, notebooks/pictures/
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
from PIL import Image

from probmotion import Comparison
from probmotion.plots.skeletons import draw_skeletons
from probmotion.problems import load_problem

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "notebooks" / "pictures"
SHOWN = ("exact", "mas", "mvpc", "nuts")


def replace_block(text: str, name: str, block: str) -> str:
    """Return the README with the block between its two comments replaced."""
    pattern = rf"(<!-- {name}:.*?-->\n).*?(<!-- end of {name} -->)"
    changed, count = re.subn(pattern, lambda m: m[1] + block + "\n" + m[2], text, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"README.md has {count} blocks called {name!r}, expected 1")
    return changed


def save_small(path: Path) -> None:
    """Write a picture again with few colours, so that the repository stays small."""
    picture = Image.open(path).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """Rewrite the README's figures."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    comparison = Comparison.load(ROOT / "demo")
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    text = replace_block(text, "demo table", f"```text\n{comparison.table()}\n```")
    readme.write_text(text, encoding="utf-8")

    PICTURES.mkdir(exist_ok=True)
    drawn = [PICTURES / name for name in ("quality_against_cost.png", "gait-monocular.png")]
    comparison.plot(drawn[0])
    problem = load_problem("gait-monocular")
    rows = {name: comparison.draws(problem.name, name).flat()[5::10] for name in SHOWN}
    draw_skeletons(
        rows,
        problem.posterior.skeleton,
        drawn[1],
        azimuth=np.pi / 2,
        truth=problem.truth,
    )
    for path in drawn:
        save_small(path)


if __name__ == "__main__":
    main()

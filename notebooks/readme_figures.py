"""Put the figures of a finished ``make demo`` into the README: its tables and its pictures.

python notebooks/readme_figures.py            # reads demo/, writes README.md, notebooks/pictures/
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from PIL import Image

from probmotion import Comparison
from probmotion.pictures import draw_skeletons
from probmotion.problems import load_problem

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "notebooks" / "pictures"
SHOWN = ("exact", "mas", "mvpc", "nuts")

ADVICE = {
    "exact": "prior and evidence have a closed form, or there is no evidence and a prior that can "
    "be drawn from: nothing else is needed",
    "ensemble": "there is a log density of at most about 20 dimensions, and modes are not far "
    "apart",
    "nuts": "there is a log density with a gradient; start many chains, and look at R-hat: chains "
    "that began in different modes stay there",
    "mh": "there is a log density without a gradient; the same warning",
    "ancestral3d": "there is a 3D denoiser",
    "mvpc": "there is a 2D denoiser only",
    "mas": "to compare with the published method; `mvpc` costs the same",
    "dvae": "a network that reads the evidence comes with the prior; else it trains one first",
    "sds": "one plausible motion is enough: it does not sample",
}
"""When to take which sampler, from what is right of itself to what does not sample."""


def replace_block(text: str, name: str, block: str) -> str:
    """Return the README with the block between its two comments replaced."""
    pattern = rf"(<!-- {name}:.*?-->\n).*?(<!-- end of {name} -->)"
    changed, count = re.subn(pattern, lambda m: m[1] + block + "\n" + m[2], text, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"README.md has {count} blocks called {name!r}, expected 1")
    return changed


def advice(comparison: Comparison) -> str:
    """Return the table of advice, with each sampler's distance from exact draws and its time."""
    table = comparison.table()
    means = table.pivot_table(index="sampler", columns=["problem", "metric"], values="value")
    problems = list(comparison.plan.problems)
    heads = " | ".join(f"swd `{problem}` | seconds" for problem in problems)
    lines = [f"| take | when | {heads} |", "|---" * (2 + 2 * len(problems)) + "|"]
    for sampler, when in ADVICE.items():
        cells = []
        for problem in problems:
            for metric in ("swd", "seconds"):
                value = means.loc[sampler].get((problem, metric), np.nan)
                cells.append("–" if np.isnan(value) else f"{value:.3g}")
        lines.append(f"| `{sampler}` | {when} | {' | '.join(cells)} |")
    return "\n".join(lines)


def save_small(path: Path) -> None:
    """Write a picture again with few colours, so that the repository stays small."""
    picture = Image.open(path).convert("RGB")
    picture.quantize(32, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """Rewrite the README's figures."""
    comparison = Comparison.load(ROOT / "demo")
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    text = replace_block(text, "demo table", f"```text\n{comparison.table()}\n```")
    text = replace_block(text, "advice", advice(comparison))
    readme.write_text(text, encoding="utf-8")

    PICTURES.mkdir(exist_ok=True)
    drawn = [PICTURES / name for name in ("quality_against_cost.png", "gait-monocular.png")]
    comparison.plot(drawn[0])
    problem = load_problem("gait-monocular")
    rows = {name: comparison.draws(problem.name, name).flat()[25::50] for name in SHOWN}
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

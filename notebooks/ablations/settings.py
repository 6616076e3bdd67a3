"""Effect of each sampler's own settings.

    python notebooks/ablations/settings.py --out settings
    python notebooks/ablations/settings.py --out quick --draws 12 --seeds 1     (two minutes)

``--studies`` selects studies. Each is a comparison in a folder of ``--out`` with its table and
report; an interrupted study continues from there.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from probmotion.comparison import compare
from probmotion.posteriors.sampling import Sampler
from probmotion.samplers import (
    NUTS,
    Ensemble,
    MetropolisHastings,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
)


@dataclass(frozen=True)
class Study:
    """Variants of a sampler and the problems they are run on."""

    about: str
    problems: tuple[str, ...]
    samplers: Mapping[str, Sampler]


STUDIES = {
    "views": Study(
        "how many views, and whether they share their noise",
        ("gait", "gait-monocular"),
        {
            **{f"mas, {n} views": MultiViewAncestral(n_views=n) for n in (2, 3, 5, 9)},
            "mas, noise of its own": MultiViewAncestral(shared_noise=False),
        },
    ),
    "correctors": Study(
        "how much is corrected, at how many levels",
        ("gait", "gait-monocular"),
        {
            "mvpc, no corrector": MultiViewPredictorCorrector(corrector_steps=0),
            "mvpc": MultiViewPredictorCorrector(),
            "mvpc, 3 correctors": MultiViewPredictorCorrector(corrector_steps=3),
            "mvpc, 100 levels": MultiViewPredictorCorrector(steps=100),
            "mvpc, accurate": MultiViewPredictorCorrector.accurate(),
        },
    ),
    "chains": Study(
        "how long chains run",
        ("gait-monocular", "gait-sparse"),
        {
            **{f"mh, every {n}th": MetropolisHastings(thin=n) for n in (5, 20, 80)},
            **{f"ensemble, every {n}th": Ensemble(thin=n) for n in (10, 50)},
            **{f"nuts, warmup {n}": NUTS(warmup=n) for n in (100, 500)},
        },
    ),
}


def main() -> None:
    """Run the selected studies and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    for name in asked.studies:
        study = STUDIES[name]
        found = compare(
            study.problems,
            study.samplers,
            draws=asked.draws,
            chains=4,
            seeds=asked.seeds,
            workers=asked.workers,
            out=asked.out / name,
        )
        page = found.report(asked.out / name / "report.html")
        print(f"\n{name}: {study.about}\n\n{found.table()}\n\nwrote {page}", flush=True)


if __name__ == "__main__":
    main()

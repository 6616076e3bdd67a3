"""Effect of the settings of each sampler.

    python notebooks/ablations/settings.py --out settings
    python notebooks/ablations/settings.py --out quick --draws 12 --seeds 1     (two minutes)

``--studies`` selects studies. Each is a comparison, stored with its table and report in a folder of
``--out``; run the same command again to resume an interrupted study.
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
    """Variants of a sampler and the problems to which they are applied."""

    about: str
    problems: tuple[str, ...]
    samplers: Mapping[str, Sampler]


STUDIES = {
    "views": Study(
        "number of views, and noise shared between views",
        ("gait", "gait-monocular"),
        {
            **{f"mas, {n} views": MultiViewAncestral(n_views=n) for n in (2, 3, 5, 9)},
            "mas, noise of its own": MultiViewAncestral(shared_noise=False),
        },
    ),
    "correctors": Study(
        "number of corrector steps and of noise levels",
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
        "length of chains",
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
    parser.add_argument("--out", type=Path, required=True, help="Output folder.")
    names = list(STUDIES)
    parser.add_argument(
        "--studies", nargs="+", choices=names, default=names, help="All by default."
    )
    parser.add_argument("--draws", type=int, default=100, help="Number of draws per run.")
    parser.add_argument("--seeds", type=int, default=3, help="Number of seeds.")
    parser.add_argument("--workers", type=int, default=2, help="Number of processes.")
    options = parser.parse_args()
    for name in options.studies:
        study = STUDIES[name]
        comparison = compare(
            study.problems,
            study.samplers,
            draws=options.draws,
            chains=4,
            seeds=options.seeds,
            workers=options.workers,
            out=options.out / name,
        )
        report = comparison.report(options.out / name / "report.html")
        print(f"\n{name}: {study.about}\n\n{comparison.table()}\n\nwrote {report}", flush=True)


if __name__ == "__main__":
    main()

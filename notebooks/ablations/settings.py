"""Effect of the settings of each sampler.

    python notebooks/ablations/settings.py --out settings
    python notebooks/ablations/settings.py --out quick --draws 12 --seeds 1

``--studies`` selects studies. Each is a comparison, stored with its table and report in a folder of
``--out``; run the same command again to resume an interrupted study.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from probmotion.comparison import compare
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems import load_problem
from probmotion.samplers import (
    NUTS,
    Ancestral3D,
    Ensemble,
    ExactSampler,
    MetropolisHastings,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
    SplitGibbs,
)
from probmotion.samplers.conditional import DAPS, REDDiff, TwistedDiffusion
from probmotion.samplers.diffusion import (
    DDPM,
    DPS,
    Cosine,
    ExactGuidance,
    Heun,
    Karras,
    LogSNR,
    MomentMatched,
    Replacement,
    SecondOrderSDE,
    StochSync,
    SyncTweedies,
)
from probmotion.samplers.independent import Batches
from probmotion.seeds import NormalStreams

CONDITIONED = (
    "gait-monocular", "gait-occluded", "gait-sparse", "cmu-monocular", "quadruped-monocular",
    "cmu-motion-monocular", "cmu-motion-occluded", "cmu-motion-denoise", "salsa-lifted",
)  # fmt: skip
BUDGETS = (500, 2000, 8000)
"""Denoiser evaluations a draw."""


@dataclass(frozen=True)
class Study:
    """Variants of a sampler and the problems to which they are applied."""

    about: str
    problems: tuple[str, ...]
    samplers: Mapping[str, Sampler]


@dataclass(frozen=True)
class MirroredSampler(ExactSampler):
    """Exact draws, each reflected in depth with probability ½.

    Views at elevation 0 do not distinguish these draws from those of the prior.
    """

    name: ClassVar[str] = "mirrored"

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        exact = super()._batches(posterior, seed, progress)

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            depth = np.where(streams.uniform() < 0.5, -1.0, 1.0)
            motions = exact.draw(streams, tick)
            motions[..., 2] *= depth[:, None, None]
            return motions

        return Batches(draw, size=1)


def conditional_methods(budget: int) -> dict[str, Sampler]:
    """Return methods of conditioning 2D denoisers, at a number of evaluations a draw."""
    # Exact denoisers have three views at a time, those of `mas` five.
    estimates = budget // 3
    # Split Gibbs has 1.25 estimates a step and 48 for its sweeps. Its default start would take all
    # of 500 evaluations.
    split = SplitGibbs(denoiser="2d", particles=2 if budget < 1000 else 8)
    started = split.particles * split.start_steps
    samplers: dict[str, Sampler] = {
        "mas": MultiViewAncestral(steps=budget // 5),
        "mas, dps": MultiViewAncestral(steps=budget // 5, guidance=DPS()),
        "mas, replacement": MultiViewAncestral(steps=budget // 5, guidance=Replacement()),
        "mvpc": MultiViewPredictorCorrector(steps=round(estimates / 1.63)),
        "split-gibbs": replace(split, steps=round((estimates - started - 48) / 1.25)),
        "daps": DAPS(denoiser="2d", steps=estimates // 5),
        "red-diff": REDDiff(denoiser="2d", steps=estimates),
        "sync-tweedies": SyncTweedies(steps=estimates),
        "stoch-sync": StochSync(steps=estimates // 5),
        "tds": TwistedDiffusion(denoiser="2d", particles=estimates // 50),
    }
    return {f"{name}, {budget}": sampler for name, sampler in samplers.items()}


STUDIES = {
    "integrators": Study(
        "integrators and noise levels at 50 evaluations of a 3D denoiser",
        ("gait", "cmu", "quadruped", "cmu-motion"),
        {
            "ddpm, cosine": Ancestral3D(levels=Cosine(), integrator=DDPM()),
            "second order, cosine": Ancestral3D(levels=Cosine()),
            "second order, karras": Ancestral3D(levels=Karras()),
            "second order, log-snr": Ancestral3D(),
            "heun, log-snr": Ancestral3D(steps=25, integrator=Heun()),
            "ddpm, log-snr": Ancestral3D(integrator=DDPM()),
        },
    ),
    "guidance": Study(
        "guidance of ancestral3d at 50 evaluations of a 3D denoiser",
        CONDITIONED,
        {
            "moment matching": Ancestral3D(),
            "moment matching, 6 steps": Ancestral3D(guidance=MomentMatched()),
            "exact": Ancestral3D(guidance=ExactGuidance()),
        },
    ),
    "elevations": Study(
        "views of the pool: one ring at an elevation, or over the sphere",
        ("gait", "cmu"),
        {
            "mas, second order": MultiViewAncestral(
                steps=95, levels=LogSNR(), integrator=SecondOrderSDE()
            ),
            "exact": ExactSampler(),
            "exact, mirrored, elevation 0": MirroredSampler(),
            "mas, second order, elevation 0": MultiViewAncestral(
                steps=95, levels=LogSNR(), integrator=SecondOrderSDE(), elevation=0.0
            ),
            "mvpc, elevation 0": MultiViewPredictorCorrector(steps=58, elevation=0.0),
            "mvpc, elevation 11": MultiViewPredictorCorrector(steps=58, elevation=np.pi / 16),
            "mvpc, elevation 35": MultiViewPredictorCorrector(
                steps=58, elevation=np.arctan(0.5**0.5)
            ),
            "mvpc, sphere": MultiViewPredictorCorrector(),
        },
    ),
    "network": Study(
        "levels and integrators of a network trained on 100 levels",
        ("walk2d",),
        {
            **{
                f"{name}, {steps} levels, {integrator.kind}": replace(
                    sampler, steps=steps, levels=Cosine(trained_steps=100), integrator=integrator
                )
                for name, sampler in {
                    "mas": MultiViewAncestral(perspective=True),
                    "mvpc": MultiViewPredictorCorrector.learnt(),
                }.items()
                for steps in (20, 50, 100)
                for integrator in (DDPM(), SecondOrderSDE(), Heun())
            },
            # Levels that are not those of training.
            "mas, 100 levels, karras": MultiViewAncestral(
                perspective=True, levels=Karras(smallest=0.026), integrator=SecondOrderSDE()
            ),
            "mvpc, 97 levels, karras": MultiViewPredictorCorrector(gamma=0.5),
        },
    ),
    "conditioning": Study(
        "conditioning of 2D denoisers at equal numbers of evaluations",
        CONDITIONED,
        {
            name: sampler
            for budget in BUDGETS
            for name, sampler in conditional_methods(budget).items()
        },
    ),
    "split-gibbs": Study(
        "split Gibbs with denoisers of 3D motion and of 2D views",
        CONDITIONED,
        {
            "split-gibbs, 3d": SplitGibbs(denoiser="3d"),
            "split-gibbs, 2d": SplitGibbs(denoiser="2d"),
        },
    ),
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
    "tuning": Study(
        "noise covariance and corrector of mvpc, at 474 evaluations",
        ("gait", "cmu", "quadruped"),
        {
            "default": MultiViewPredictorCorrector(),
            "no corrector": MultiViewPredictorCorrector(steps=158, corrector_steps=0),
            **{
                f"gamma {gamma:g} from {start:g}, corrector {size:g}": (
                    MultiViewPredictorCorrector(corrector_size=size, gamma=gamma, gamma_from=start)
                )
                for gamma, start, size in (
                    (0, 1, 0.6),
                    (0.5, 1, 0.6),
                    (1, 1, 0.6),
                    (0.5, 0.2, 0.3),
                    (0.55, 0.2, 0.15),
                )
            },
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


def on_device(name: str, device: str) -> str | Problem:
    """Return a problem with its networks on a device; only walk2d has networks."""
    if name != "walk2d" or device == "cpu":
        return name
    problem = load_problem(name)
    prior = MotionDiffusion.load(name, device=device)
    evaluator = TrackEvaluator.load(f"{name}-evaluator", device=device)
    return replace(
        problem,
        posterior=replace(problem.posterior, prior=prior),
        generation=replace(problem.generation, evaluator=evaluator),
    )


def main() -> None:
    """Run the selected studies and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="Output folder.")
    names = list(STUDIES)
    parser.add_argument(
        "--studies", nargs="+", choices=names, default=names, help="All by default."
    )
    parser.add_argument("--problems", nargs="+", help="Some of each study's problems.")
    parser.add_argument("--samplers", help="Only variants whose name contains this.")
    parser.add_argument("--draws", type=int, default=100, help="Number of draws per run.")
    parser.add_argument("--seeds", type=int, default=3, help="Number of seeds.")
    parser.add_argument("--workers", type=int, default=2, help="Number of processes.")
    parser.add_argument("--device", default="cpu", help="Device of networks: cpu, cuda or auto.")
    options = parser.parse_args()
    for name in options.studies:
        study = STUDIES[name]
        wanted = options.samplers or ""
        problems = [each for each in study.problems if each in (options.problems or study.problems)]
        comparison = compare(
            [on_device(each, options.device) for each in problems],
            {each: sampler for each, sampler in study.samplers.items() if wanted in each},
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

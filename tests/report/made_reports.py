"""Comparisons with made-up numbers and draws."""

from __future__ import annotations

import numpy as np

from probmotion import Cameras, MotionDraws, MotionPosterior, seeds
from probmotion.comparison import Comparison
from probmotion.comparison.results.failures import Failure
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import RunResult
from probmotion.comparison.results.stored_problems import store_problem
from probmotion.data.synthetic.gaits import make_gait
from probmotion.metrics.verdict import Quantity, Verdict
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.problem import Problem

MARKUP = "</script><script>alert(1)</script><b onclick='x'>&\"'"
WALK = make_gait("walk", frames=12)


def walk_prior(walk=WALK) -> GaussianMixtureMotion:
    """Return a prior of motions close to one walk."""
    noise = np.random.default_rng(0).normal(size=(1, 2, *walk.positions.shape))
    return GaussianMixtureMotion(
        skeleton=walk.skeleton, fps=30.0, means=walk.positions[None], factors=0.02 * noise,
        weights=np.ones(1), noise=0.01, azimuths=1, styles=("walk",),
    )  # fmt: skip


def filmed_problem(observed: int) -> Problem:
    """Return a walk that a perspective camera observes in the first frames."""
    camera = Cameras.around(np.array([0.7]), np.array([0.3]), perspective=True)
    visible = np.zeros((1, *WALK.positions.shape[:2]))
    visible[:, :observed] = 1
    likelihood = Keypoints2D(camera.project(WALK.positions), camera, 0.02, visible)
    posterior = MotionPosterior(walk_prior(), likelihood)
    return Problem("filmed", f"a walk {MARKUP}", posterior, WALK.positions)


def joints_problem() -> Problem:
    posterior = MotionPosterior(walk_prior(), Joints3D.observe(WALK, 0.02, 0))
    return Problem("joints", f"joints {MARKUP}", posterior, WALK.positions)


def generation_problem() -> Problem:
    return Problem("generation", "no observations", MotionPosterior(walk_prior()))


class Named:
    name = "made"


class MadeComparison(Comparison):
    """Comparison of samplers with given swd ratios; None fails always, "b<i>ad" at seed 1."""

    def __init__(self, folder, problems, samplers, n_seeds=1) -> None:
        self.folder = folder
        self.problems = {problem.name: problem for problem in problems}
        self.samplers = samplers
        settings = {name: {"path": MARKUP} if "<" in name else {} for name in samplers}
        described = {name: problem.description for name, problem in self.problems.items()}
        self.plan = Plan(described, settings, draws=8, chains=2, seeds=n_seeds)
        self.results = [self._result(*address) for address in self.plan.runs()]
        for problem in problems:
            store_problem(problem, folder / "problems" / problem.name, draws=2)

    def _result(self, problem: str, sampler: str, seed: int) -> RunResult:
        failure, swd = None, self.samplers[sampler]
        if swd is None:
            failure = Failure("obs<u>erved", f"it cannot {MARKUP}", unsupported=True)
            return RunResult(problem, sampler, seed, "", {}, failure)
        if "<" in sampler and seed == 1:
            failure = Failure("crashed", "singular matrix", unsupported=False)
        metrics = {"swd_ratio": swd + seed, "seconds": 3 * swd, "odd_one": 7.0, "rhat": np.nan}
        return RunResult(problem, sampler, seed, "", {} if failure else metrics, failure)

    def judge(self, problem: str, **words: str) -> None:
        """Set the verdicts on samplers."""
        quantity = Quantity("variance", 0.5, 1.0, 1.25, 0.001, 0.9, 40)
        sentences = {
            "undecided": "undecided at 9 draws",
            "overconfident": "overconfident ×1.3 and biased by 2 sd",
            "biased": "biased by 2 sd",
        }
        for name, word in words.items():
            verdict = Verdict(word, sentences.get(word, word), 9, (quantity,))
            self._verdicts[problem, name] = verdict

    def draws(self, problem: str, sampler: str, seed: int = 0) -> MotionDraws:
        rng = seeds.generator(seed, problem, sampler)
        spread = 0.02 if sampler == "good" else 0.1
        drawn = WALK.positions + spread * rng.normal(size=(2, 4, *WALK.positions.shape))
        posterior = self.problems[problem].posterior
        return MotionDraws.of(posterior, Named(), drawn, seed=seed, seconds=1.0)

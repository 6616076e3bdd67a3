"""Table and report of a grid that is larger than the memory."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import weakref

import numpy as np
import pytest
from made_reports import MadeComparison, Named, generation_problem, joints_problem, walk_prior
from own_files import STATISTICS

from probmotion import MotionDraws, MotionPosterior
from probmotion.comparison.figures import draw_comparison
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import RunResult
from probmotion.data.synthetic.gaits import make_gait
from probmotion.report.animations import compared_draws, shown_problems

# A process of its own, because the peak of this one may be that of other tests.
REPORT = """
import sys
from pathlib import Path
from probmotion.comparison import Comparison
comparison = Comparison.load(sys.argv[1])
assert len(comparison.table()) == 3000
print(comparison.table())
print(comparison.report(sys.argv[2]).stat().st_size)
(peak,) = [line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line]
print(int(peak.split()[1]) / 2**20)
"""


class Watched(MadeComparison):
    """Comparison that counts how many earlier draws are in memory when others are read."""

    alive, most = (), 0

    def draws(self, problem, sampler, seed=0):
        gc.collect()
        self.alive = [array for array in self.alive if array() is not None]
        self.most = max(self.most, len(self.alive))
        draws = super().draws(problem, sampler, seed)
        self.alive = [*self.alive, weakref.ref(draws.positions.values)]
        return draws


@pytest.mark.usefixtures("few_objects")
def test_draws_are_read_one_by_one(tmp_path):
    problems = [generation_problem(), joints_problem()]
    made = Watched(tmp_path, problems, dict.fromkeys("abc", 1.0))
    for name, shown in zip(made.plan.problems, shown_problems(made), strict=True):
        assert set(shown.rows) >= set("abc")
        assert compared_draws(made, name, {})
    draw_comparison(made, problems[:1], tmp_path)
    assert made.most <= 1


@pytest.mark.slow
def test_a_thousand_runs_are_reported_without_loading_them_all(tmp_path):
    """10 GB of draws of 10 problems, 50 samplers and 2 seeds, half of which the page reads."""
    problems = {f"problem {i}": "a walk" for i in range(10)}
    samplers = {f"sampler {i}": {} for i in range(50)}
    prints = {"problem": dict.fromkeys(problems, "a"), "sampler": dict.fromkeys(samplers, "b")}
    plan = Plan(problems, samplers, draws=20, chains=2, seeds=2, fingerprints=prints)
    plan.save(tmp_path)
    # Few and long motions, so that even a few of each run are too many.
    walk = make_gait("walk", frames=1250)
    noise = 0.01 * np.random.default_rng(0).normal(size=(2, 10, *walk.positions.shape))
    posterior = MotionPosterior(walk_prior(walk))
    made = MotionDraws.of(posterior, Named(), walk.positions + noise, seed=1, seconds=1.0)
    draws = tmp_path / "draws.nc"
    made.save(draws)
    size = draws.stat().st_size
    assert 1000 * size > 10e9
    for problem, sampler, seed in plan.runs():
        home = plan.run_folder(tmp_path, problem, sampler, seed)
        home.mkdir(parents=True)
        metrics = {"swd_ratio": 1.0 + seed, "seconds": 1.0, "rhat": 1.0}
        run = RunResult(problem, sampler, seed, "0" * 16, metrics, None, None, size, STATISTICS)
        (home / "run.json").write_text(json.dumps(vars(run)))
        os.link(draws, home / "draws.nc")
    page = tmp_path / "report.html"
    command = [sys.executable, "-c", REPORT, tmp_path, page]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    assert "sampler 49" in "\n".join(lines)
    assert page.read_text(encoding="utf-8").count("<canvas") == 500 + 3
    assert int(lines[-2]) < 20e6
    assert float(lines[-1]) < 1.0, f"peak of {lines[-1]} GiB"

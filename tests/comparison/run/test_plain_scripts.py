"""What a user's script or notebook defines takes part, in processes, without ceremony."""

from __future__ import annotations

import json
import subprocess
import sys

SCRIPT = """
import json, os, signal, sys, time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import probmotion as pm
from probmotion.comparison import compare
from probmotion.draws import MotionDraws
from probmotion.models import GaussianMixtureMotion

print("the script runs", file=sys.stderr)


class Taller(GaussianMixtureMotion):
    pass


@dataclass(frozen=True)
class Mine:
    name: ClassVar[str] = "mine"
    requires: ClassVar[tuple] = ()

    def sample(self, posterior, *, draws=1000, chains=1, seed=0, initial=None, progress=True):
        start = time.perf_counter()
        flat = posterior.prior.sample(np.random.default_rng(seed), chains * draws)
        motions = flat.reshape(chains, draws, *flat.shape[1:])
        seconds = time.perf_counter() - start
        return MotionDraws.of(posterior, self, motions, seed=seed, seconds=seconds)


@dataclass(frozen=True)
class Greedy(Mine):
    name: ClassVar[str] = "greedy"

    def sample(self, posterior, **asked):
        # As the system does to who takes its last memory.
        os.kill(os.getpid(), signal.SIGKILL)


rng = np.random.default_rng(0)
prior = Taller(
    skeleton=pm.Skeleton(["root", "a", "b"], [-1, 0, 1]), fps=30.0,
    means=rng.normal(size=(1, 4, 3, 3)), factors=0.4 * rng.normal(size=(1, 2, 4, 3, 3)),
    noise=0.1, weights=np.ones(1), azimuths=1,
)
found = compare(pm.MotionPosterior(prior), [Mine(), Greedy()], draws=20, progress=False)
print(json.dumps({
    result.sampler: result.failure.word if result.failure else "draws" for result in found.results
}))
"""


def test_a_script_needs_no_guard_and_survives_what_its_sampler_does(tmp_path):
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    ran = subprocess.run(
        [sys.executable, str(path)], capture_output=True, text=True, timeout=120, cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == {"mine": "draws", "greedy": "memory"}
    # No worker runs it again.
    assert ran.stderr.count("the script runs") == 1

"""A package of somebody else's, made on the fly, takes part by its entry point."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import pytest

SAMPLER = '''
"""A sampler of another package's."""
import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probmotion import MotionDraws, seeds
from probmotion.priors import HasLogDensity


@dataclass(frozen=True)
class Importance:
    """Sampling-importance-resampling from the prior."""

    name: ClassVar[str] = "importance"
    requires: ClassVar[tuple[type, ...]] = (HasLogDensity,)
    effort: ClassVar[tuple[str, ...]] = ("candidates",)

    candidates: int = 500

    def sample(self, posterior, *, draws=1000, chains=1, seed=0, initial=None, progress=True):
        start = time.perf_counter()
        theta = []
        for chain in range(chains):
            rng = seeds.generator(seed, "importance", chain)
            points = posterior.initial(rng, self.candidates)
            weight = np.exp(posterior.log_likelihood(points))
            theta.append(points[rng.choice(self.candidates, draws, p=weight / weight.sum())])
        theta = np.stack(theta)
        rng = seeds.generator(seed, "motions")
        flat = posterior.complete(rng, theta.reshape(-1, posterior.dim))
        return MotionDraws.of(
            posterior, self, flat.reshape(chains, draws, *flat.shape[1:]), seed=seed,
            seconds=time.perf_counter() - start, theta=theta,
            counts={"density": chains * self.candidates},
        )
'''

RUN = """
import json, sys
import numpy as np
import probmotion as pm
from probmotion.comparison import Budget, compare
from probmotion.models import GaussianMixtureMotion
from probmotion.sampling import load_sampler, sampler_names, suited

if __name__ == "__main__":
    rng = np.random.default_rng(0)
    prior = GaussianMixtureMotion(
        skeleton=pm.Skeleton(["root", "a", "b"], [-1, 0, 1]), fps=30.0,
        means=rng.normal(size=(1, 4, 3, 3)), factors=0.4 * rng.normal(size=(1, 2, 4, 3, 3)),
        noise=0.1, weights=np.ones(1), azimuths=1,
    )
    truth = pm.Motion(prior.sample(rng, 1)[0], prior.skeleton, 30.0)
    seen = pm.Keypoints2D.observe(truth, pm.Cameras.ring(1, elevation=0.2), noise=0.5, seed=0)
    posterior = pm.MotionPosterior(prior, seen)
    found = compare(
        {"mine": posterior}, ["importance", "exact"], draws=40, chains=2, workers=2,
        budget=Budget(evaluations=3000), out=sys.argv[1], progress=False,
    )
    table = found.table()
    print(json.dumps({
        "listed": "importance" in sampler_names(),
        "module": load_sampler("importance").__module__,
        "words": table.attrs["words"],
        "failures": [result.failure.message for result in found.failures],
        "swd_ratio": dict(table[table["metric"] == "swd_ratio"].set_index("sampler")["value"]),
        "settings": {r.sampler: r.budget["settings"] for r in found.results},
        "suited": suited(posterior),
    }))
"""

BROKEN = """
import json
import warnings
import numpy as np
import probmotion as pm
from probmotion.comparison import compare
from probmotion.comparison.naming import named_samplers
from probmotion.models import GaussianMixtureMotion
from probmotion.samplers import ExactSampler
from probmotion.sampling import load_sampler, sampler_names, suited

class Bare:
    skeleton, frames, fps, dim = pm.Skeleton(["a"], [-1]), 1, 30.0, 3

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 1, 1, 3)

rng = np.random.default_rng(0)
prior = GaussianMixtureMotion(
    skeleton=pm.Skeleton(["root", "a", "b"], [-1, 0, 1]), fps=30.0,
    means=rng.normal(size=(1, 4, 3, 3)), factors=0.4 * rng.normal(size=(1, 2, 4, 3, 3)),
    noise=0.1, weights=np.ones(1), azimuths=1,
)

def said(call):
    try:
        call()
    except Exception as error:
        return [type(error).__name__, str(error)]

exact = ExactSampler()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    names = list(named_samplers(None))
print(json.dumps({
    "listed": sampler_names(),
    "suited": suited(pm.MotionPosterior(prior)),
    "unsupported": said(lambda: exact.sample(pm.MotionPosterior(Bare()), draws=1)),
    "loaded": {name: said(lambda: load_sampler(name)) for name in ("gone", "bare", "wild")},
    "all": [names, [str(warning.message) for warning in caught]],
    "other": said(lambda: compare("gait", "exact", draws=10, chains=1, workers=0, progress=False)),
}))
"""


@pytest.fixture
def package(tmp_path):
    """A package as pip would leave it in a folder on the path."""
    site = tmp_path / "site"
    (site / "walkers_of_ours").mkdir(parents=True)
    (site / "walkers_of_ours" / "__init__.py").write_text(SAMPLER)
    information = site / "walkers_of_ours-0.3.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: walkers-of-ours\nVersion: 0.3\n"
    )
    (information / "entry_points.txt").write_text(
        "[probmotion.samplers]\nimportance = walkers_of_ours:Importance\n"
    )
    return site


def test_its_sampler_runs_beside_ours_on_a_posterior_of_one_s_own(package, tmp_path):
    (tmp_path / "run.py").write_text(RUN)
    paths = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, "-W", "error", str(tmp_path / "run.py"), str(tmp_path / "out")],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert found["listed"]
    assert found["module"] == "walkers_of_ours"
    assert found["failures"] == []
    assert set(found["swd_ratio"]) == {"importance", "exact"}
    assert found["swd_ratio"]["importance"] < 3
    # Its effort is spent like that of our own samplers.
    assert found["settings"] == {"importance": {"candidates": 1500}, "exact": {}}
    assert "importance" in found["suited"]


NEEDY = """

class Needy(Importance):
    def __init__(self, model):
        self.model = model
"""


def test_whatever_they_are_called_and_whatever_they_need_they_stop_no_others(package, tmp_path):
    (package / "walkers_of_ours" / "__init__.py").write_text(SAMPLER + NEEDY)
    names = ["my.good", "1st", "lambda", "my good", "my-good", "plain"]
    entries = [*(f"{name} = walkers_of_ours:Importance" for name in names)]
    entries += ["needy = walkers_of_ours:Needy", "mh = walkers_of_ours:Importance"]
    (package / "walkers_of_ours-0.3.dist-info" / "entry_points.txt").write_text(
        "\n".join(["[probmotion.samplers]", *entries])
    )
    paths = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])

    def said(*samplers):
        words = ["compare", "gait-monocular(frames=4)", "--samplers", *samplers, "--draws", "10"]
        words += ["--workers", "0", "--out", str(tmp_path / "out")]
        command = "import sys; from probmotion.cli import main; sys.exit(main())"
        run = subprocess.run(
            [sys.executable, "-c", command, *words],
            env={**os.environ, "PYTHONPATH": paths},
            capture_output=True,
            text=True,
            timeout=200,
        )
        return run.returncode, run.stdout, run.stderr

    status, table, notes = said("exact", "my.good", "1st", "lambda", "my good")
    assert status == 0, notes
    for name in ("exact", "my.good", "1st", "lambda", "my good"):
        assert re.search(rf"^{re.escape(name)} .* [0-9.]+", table, re.MULTILINE)
    assert "sampler 'mh' of the package walkers-of-ours is left out" in notes
    assert "'needy', which cannot be made without settings (TypeError" in notes
    assert "it is left out" in notes
    status, _, notes = said("needy")
    assert status == 2
    assert notes.splitlines()[-1].startswith("probmotion: sampler is 'needy', which cannot be made")
    assert "Traceback" not in notes


def test_those_that_cannot_be_imported_are_named_and_stop_no_others(package, tmp_path):
    (package / "wild.py").write_text("raise RuntimeError('two\\nlines')")
    (package / "walkers_of_ours-0.3.dist-info" / "entry_points.txt").write_text(
        "[probmotion.samplers]\n"
        "gone = gone_for_good:Sampler\nbare = walkers_of_ours:Nobody\nwild = wild:Sampler\n"
    )
    (tmp_path / "run.py").write_text(BROKEN)
    paths = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, "-W", "error", str(tmp_path / "run.py")],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert {"gone", "bare", "wild", "exact"} <= set(found["listed"])
    assert "exact" in found["suited"]
    assert not {"gone", "bare", "wild"} & set(found["suited"])
    kind, sentence = found["unsupported"]
    assert kind == "UnsupportedPosterior"
    assert sentence.startswith("exact needs a prior with ")
    for name, value, reason in [
        ("gone", "gone_for_good:Sampler", "ModuleNotFoundError: No module named 'gone_for_good'"),
        (
            "bare",
            "walkers_of_ours:Nobody",
            "AttributeError: module 'walkers_of_ours' has no attribute 'Nobody'",
        ),
        ("wild", "wild:Sampler", "RuntimeError: two lines"),
    ]:
        assert found["loaded"][name] == [
            "ValueError",
            f"sampler is {name!r}, which the package walkers-of-ours registers as {value!r}, "
            f"expected one that can be imported ({reason})",
        ]
    # Who asks for all gets all others, and is told.
    names, told = found["all"]
    assert set(names) == set(found["listed"]) - {"gone", "bare", "wild"}
    assert sorted(told) == sorted(f"{said}; it is left out" for _, said in found["loaded"].values())
    assert found["other"] is None

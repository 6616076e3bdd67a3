"""Samplers of another package take part through its entry points."""

from __future__ import annotations

import json
import os
import re

import pytest
from toy_samplers import finish, start

PACKAGE = '''
"""Samplers of another package."""
import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from probmotion import MotionDraws, seeds
from probmotion.posteriors.protocols import HasLogDensity


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


class Needy(Importance):
    def __init__(self, model):
        self.model = model
'''

SCRIPT = """
import json, sys, warnings
import numpy as np
import probmotion as pm
from probmotion.comparison import Budget, compare
from probmotion.comparison.results.naming import named_samplers
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.sampling import load_sampler, sampler_names, suited
from probmotion.samplers import ExactSampler

class Bare:
    skeleton, frames, fps, dim = pm.Skeleton(["a"], [-1]), 1, 30.0, 3

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 1, 1, 3)

def message(call):
    try:
        call()
    except Exception as error:
        return [type(error).__name__, str(error)]

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
    {"mine": posterior}, ["importance", "exact"], draws=40, chains=2, workers=1,
    budget=Budget(evaluations=3000), out=sys.argv[1], progress=False,
)
table = found.table()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    names = list(named_samplers(None))
print(json.dumps({
    "listed": sampler_names(),
    "module": load_sampler("importance").__module__,
    "failures": [result.failure.message for result in found.failures],
    "swd_ratio": dict(table[table["metric"] == "swd_ratio"].set_index("sampler")["value"]),
    "settings": {r.sampler: r.budget["settings"] for r in found.results},
    "suited": suited(posterior),
    "loaded": {name: message(lambda: load_sampler(name)) for name in ("gone", "bare", "wild")},
    "all": [names, [str(warning.message) for warning in caught]],
    "unsupported": message(lambda: ExactSampler().sample(pm.MotionPosterior(Bare()), draws=1)),
}))
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a function that installs a package with entry points in a folder on the path."""
    site = tmp_path / "site"
    information = site / "walkers_of_ours-0.3.dist-info"
    information.mkdir(parents=True)
    (site / "walkers_of_ours.py").write_text(PACKAGE)
    (site / "wild.py").write_text("raise RuntimeError('two\\nlines')")
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: walkers-of-ours\nVersion: 0.3\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), os.getenv("PYTHONPATH", "")]))

    def install(entries):
        lines = [f"{name} = {value}" for name, value in entries.items()]
        (information / "entry_points.txt").write_text(
            "\n".join(["[probmotion.samplers]", *lines, ""])
        )

    return install


def test_samplers_of_another_package_run_and_broken_ones_are_skipped(package, tmp_path):
    broken = {
        "gone": ("gone_for_good:Sampler", "ModuleNotFoundError: No module named 'gone_for_good'"),
        "bare": (
            "walkers_of_ours:Nobody",
            "AttributeError: module 'walkers_of_ours' has no attribute 'Nobody'",
        ),
        "wild": ("wild:Sampler", "RuntimeError: two lines"),
    }
    entries = {name: value for name, (value, _) in broken.items()}
    package({"importance": "walkers_of_ours:Importance"} | entries)
    (tmp_path / "run.py").write_text(SCRIPT)
    output, _ = finish(start("-W", "error", tmp_path / "run.py", tmp_path / "out"))
    found = json.loads(output)
    assert {"importance", "exact", *broken} <= set(found["listed"])
    assert found["module"] == "walkers_of_ours"
    assert found["failures"] == []
    assert set(found["swd_ratio"]) == {"importance", "exact"}
    assert found["swd_ratio"]["importance"] < 3
    # Its budget is spent like that of registered samplers.
    assert found["settings"] == {"importance": {"candidates": 1500}, "exact": {}}
    assert {"importance", "exact"} <= set(found["suited"])
    assert not set(broken) & set(found["suited"])
    for name, (value, reason) in broken.items():
        assert found["loaded"][name] == [
            "ValueError",
            f"sampler {name!r} of the package walkers-of-ours must be importable from {value!r}, "
            f"got {reason}",
        ]
    names, warnings = found["all"]
    assert set(names) == set(found["listed"]) - set(broken)
    assert sorted(warnings) == sorted(f"{m}; sampler skipped" for _, m in found["loaded"].values())
    kind, message = found["unsupported"]
    assert kind == "UnsupportedPosterior"
    assert message.startswith("exact needs a prior with ")


def test_unusual_names_and_samplers_without_defaults_do_not_stop_others(package, tmp_path):
    names = ["my.good", "1st", "lambda", "my good", "my-good", "plain", "mh"]
    package(
        {name: "walkers_of_ours:Importance" for name in names} | {"needy": "walkers_of_ours:Needy"}
    )
    command = "import sys; from probmotion.cli.main import main; sys.exit(main())"

    def run(*samplers, returncode):
        words = ["compare", "gait-monocular(frames=4)", "--samplers", *samplers, "--draws", "10"]
        words += ["--workers", "0", "--out", tmp_path / "out"]
        return finish(start("-c", command, *words), returncode)

    table, notes = run("exact", "my.good", "1st", "lambda", "my good", returncode=0)
    for name in ("exact", "my.good", "1st", "lambda", "my good"):
        assert re.search(rf"^{re.escape(name)} .* [0-9.]+", table, re.MULTILINE)
    assert "sampler 'mh' of the package walkers-of-ours is skipped" in notes
    assert "sampler 'needy' must have default settings, got TypeError" in notes
    assert "sampler skipped" in notes
    _, notes = run("needy", returncode=2)
    expected = "probmotion: sampler 'needy' must have default settings"
    assert notes.splitlines()[-1].startswith(expected)
    assert "Traceback" not in notes

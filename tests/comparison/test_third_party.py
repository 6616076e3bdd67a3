"""Samplers that another package registers by its entry points."""

from __future__ import annotations

import json
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
        rng = seeds.generator(seed, "importance")
        points = posterior.initial(rng, self.candidates)
        weight = np.exp(posterior.log_likelihood(points))
        theta = points[rng.choice(self.candidates, (chains, draws), p=weight / weight.sum())]
        flat = posterior.complete(theta.reshape(-1, posterior.dim), rng)
        return MotionDraws.of(
            posterior, self, flat.reshape(chains, draws, *flat.shape[1:]), seed=seed,
            seconds=time.perf_counter() - start, theta=theta,
            counts={"density": self.candidates},
        )


class Needy(Importance):
    def __init__(self, model):
        self.model = model
'''

SCRIPT = """
import io, json, sys, warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace

from probmotion.cli.main import main
from probmotion.comparison import Budget, compare
from probmotion.comparison.results.naming import named_samplers
from probmotion.posteriors.sampling import load_sampler, sampler_names, suited
from toy_samplers import monocular

def warned(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return call(), [str(warning.message) for warning in caught]

def message(call):
    try:
        call()
    except Exception as error:
        return [type(error).__name__, str(error)]

def command(*words):
    words = ["compare", "gait-monocular(frames=4)", "--samplers", *words, "--draws", "10"]
    with redirect_stdout(io.StringIO()) as output, redirect_stderr(io.StringIO()) as errors:
        status = main([*words, "--workers", "0", "--out", sys.argv[1] + "-of-command"])
    return status, output.getvalue(), errors.getvalue()

posterior = monocular().posterior
posterior = replace(posterior, likelihood=replace(posterior.likelihood, noise=0.5))
listed = warned(sampler_names)
comparison = compare(
    {"mine": posterior}, ["importance", "exact"], draws=40, chains=2, workers=1,
    budget=Budget(evaluations=3000), out=sys.argv[1], progress=False,
)
table = comparison.table()
result = {
    "listed": listed,
    "module": load_sampler("importance").__module__,
    "failures": [result.failure.message for result in comparison.failures],
    "swd_ratio": dict(table[table["metric"] == "swd_ratio"].set_index("sampler")["value"]),
    "settings": {r.sampler: r.budget["settings"] for r in comparison.results},
    "suited": warned(lambda: suited(posterior))[0],
    "loaded": {name: message(lambda: load_sampler(name)) for name in ("gone", "bare", "wild")},
    "all": warned(lambda: list(named_samplers(None))),
}
warnings.simplefilter("always")
result["command"] = command("exact", "my.good", "1st", "lambda", "my good")
result["needy"] = command("needy")
print(json.dumps(result))
"""
UNUSUAL = ["my.good", "1st", "lambda", "my good", "my-good", "plain"]
BROKEN = {
    "gone": ("missing_module:Sampler", "ModuleNotFoundError: No module named 'missing_module'"),
    "bare": (
        "particle_samplers:Nobody",
        "AttributeError: module 'particle_samplers' has no attribute 'Nobody'",
    ),
    "wild": ("wild:Sampler", "RuntimeError: two lines"),
}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Output of the script with the package's entry points on the path."""
    site = tmp_path_factory.mktemp("site")
    information = site / "particle_samplers-0.3.dist-info"
    information.mkdir()
    (site / "particle_samplers.py").write_text(PACKAGE)
    (site / "wild.py").write_text("raise RuntimeError('two\\nlines')")
    (site / "run.py").write_text(SCRIPT)
    metadata = "Metadata-Version: 2.1\nName: particle-samplers\nVersion: 0.3\n"
    (information / "METADATA").write_text(metadata)
    entries = {name: "particle_samplers:Importance" for name in ("importance", "mh", *UNUSUAL)}
    entries |= {name: value for name, (value, _) in BROKEN.items()}
    entries["needy"] = "particle_samplers:Needy"
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (information / "entry_points.txt").write_text("\n".join(["[probmotion.samplers]", *lines, ""]))
    output, _ = finish(start("-W", "error", site / "run.py", site / "out"))
    return json.loads(output)


def test_samplers_of_another_package_are_compared_within_a_budget(result):
    listed, warnings = result["listed"]
    assert {"importance", "exact", "needy", *BROKEN, *UNUSUAL} <= set(listed)
    (warning,) = warnings
    assert warning.startswith("sampler 'mh' of the package particle-samplers is skipped")
    assert result["module"] == "particle_samplers"
    assert result["failures"] == []
    assert set(result["swd_ratio"]) == {"importance", "exact"}
    assert result["swd_ratio"]["importance"] < 3
    assert result["settings"] == {"importance": {"candidates": 3000}, "exact": {}}


def test_broken_samplers_are_skipped(result):
    assert {"importance", "exact"} <= set(result["suited"])
    assert not set(BROKEN) & set(result["suited"])
    for name, (value, reason) in BROKEN.items():
        assert result["loaded"][name] == [
            "ValueError",
            f"sampler {name!r} of the package particle-samplers must be importable from {value!r}, "
            f"got {reason}",
        ]
    names, warnings = result["all"]
    assert set(names) == set(result["listed"][0]) - {*BROKEN, "needy"}
    expected = {f"{message}; sampler skipped" for _, message in result["loaded"].values()}
    (needy,) = set(warnings) - expected
    assert needy.startswith("sampler 'needy' must have default settings, got TypeError")
    assert len(warnings) == len(BROKEN) + 1


def test_the_command_line_accepts_unusual_names(result):
    status, table, notes = result["command"]
    assert status == 0
    for name in ("exact", "my.good", "1st", "lambda", "my good"):
        assert re.search(rf"^{re.escape(name)} .* [0-9.]+", table, re.MULTILINE)
    assert "note: sampler 'needy' must have default settings, got TypeError" in notes
    status, _, notes = result["needy"]
    assert status == 2
    expected = "probmotion: sampler 'needy' must have default settings"
    assert notes.splitlines()[-1].startswith(expected)

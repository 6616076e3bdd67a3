"""Measure the first steps: the demonstration, import, scoring and verdicts.

``demo_lines``, ``demo_seconds`` and ``page_megabytes`` measure the Makefile's ``demo``, run in
a temporary folder. ``score_seconds`` measures the first :func:`probmotion.score` of 200 draws.
``verdict_false_alarm`` and ``verdict_right`` are the fractions of sets of 400 exact draws that are
judged wrong and right. ``verdict_power`` is the smallest fraction, over four faults, of sets that
are judged wrong for the right reason.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from sklearn.decomposition import PCA

import probmotion as pm
from probmotion import seeds
from probmotion.metrics.chains import chain_diagnostics
from probmotion.metrics.measures import load_libraries
from probmotion.metrics.run_statistics import draw_statistics
from probmotion.metrics.verdict import Verdict, judge
from probmotion.posteriors import MotionDraws, Problem
from probmotion.problems import load_problem

DRAWS, EXACT_SETS, FAULTY_SETS = 400, 200, 100
MAKEFILE = Path(__file__).parents[1] / "Makefile"


@dataclass(frozen=True)
class _Given:
    name: ClassVar[str] = "given"


def verdict(problem: Problem, motions: np.ndarray) -> Verdict:
    """Return the verdict on independent draws."""
    draws = MotionDraws.of(
        problem.posterior, _Given(), motions[None], seed=0, seconds=0.0, independent=True
    )
    return judge([draw_statistics(problem, draws, 0, {})])


def exact(problem: Problem, sets: int, n: int = DRAWS) -> Iterator[np.ndarray]:
    """Yield sets of exact draws."""
    for number in range(sets):
        yield problem.reference(seeds.integer(1, "front door", number), n)


def overconfident(problem: Problem, motions: np.ndarray, number: int) -> np.ndarray:
    """Return draws with 1/1.3 of the spread."""
    mean = _moments(problem)[0]
    return mean + (motions - mean) / 1.3


def shifted(problem: Problem, motions: np.ndarray, number: int) -> np.ndarray:
    """Return draws shifted by ±.3 sd along one of the three leading principal directions."""
    sign, direction = divmod(number, 3)
    return motions + 0.3 * (-1) ** sign * _moments(problem)[1][direction]


def off_the_manifold(problem: Problem, motions: np.ndarray, number: int) -> np.ndarray:
    """Return draws with 1.5 times the variance off the manifold."""
    rng = seeds.generator(2, "off the manifold", number)
    noise = problem.posterior.prior.noise  # type: ignore[attr-defined]
    return motions + rng.normal(0, np.sqrt(0.5) * noise, motions.shape)


def without_a_mode(problem: Problem, motions: np.ndarray, number: int) -> np.ndarray:
    """Return draws without the first style, whose weight is .2."""
    style = problem.posterior.prior.style_responsibilities(motions)  # type: ignore[attr-defined]
    return motions[style.argmax(axis=1) != 0][:DRAWS]


FAULTS: list[tuple[str, str, Callable[[Problem, np.ndarray, int], np.ndarray]]] = [
    ("gait-monocular", "overconfident", overconfident),
    ("gait-monocular", "biased", shifted),
    ("gait-monocular", "off the manifold", off_the_manifold),
    ("gait", "misses modes", without_a_mode),
]


@lru_cache(maxsize=1)
def _moments(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and leading principal directions, times the standard deviation along them."""
    motions = problem.reference(seeds.integer(3, "front door"), 8000)
    flat = motions.reshape(len(motions), -1)
    pca = PCA(3, random_state=0).fit(flat)
    steps = pca.components_ * np.sqrt(pca.explained_variance_)[:, None]
    return motions.mean(axis=0), steps.reshape(3, *motions.shape[1:])


def measure_demo() -> None:
    """Print the figures of the demonstration's comparison."""
    text = MAKEFILE.read_text().replace("\\\n", " ")
    rule = re.search(r"^demo:.*\n\t@\$\(BIN\)/probmotion (.*)$", text, re.MULTILINE)
    assert rule is not None
    code = "from probmotion.cli.main import main; import sys; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *shlex.split(rule[1])]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        printed = subprocess.run(
            command, cwd=folder, check=True, stdout=subprocess.PIPE, text=True
        ).stdout
        seconds = time.perf_counter() - start
        sizes = [page.stat().st_size for page in Path(folder).rglob("*.html")]
    lines = printed.splitlines()
    print(f"demo_lines: {len(lines)}")
    print(f"demo_columns: {max(map(len, lines))}")
    print(f"demo_seconds: {seconds:.0f}")
    print(f"page_megabytes: {max(sizes) / 1e6:.2f}", flush=True)


def measure_import() -> None:
    """Print the seconds of ``import probmotion``."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import probmotion"], check=True)
    total = time.perf_counter() - start
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", ""], check=True)
    print(f"import_seconds: {total - (time.perf_counter() - start):.2f}", flush=True)


def measure_score() -> None:
    """Print the seconds of the first score of a problem."""
    load_libraries()
    problem = pm.problem("gait-monocular")
    draws = pm.sample(problem, "exact", draws=200, progress=False)
    start = time.perf_counter()
    pm.score(problem, draws)
    print(f"score_seconds: {time.perf_counter() - start:.2f}", flush=True)


def measure_exact() -> None:
    """Print how often exact draws are called wrong and right."""
    words: Counter[str] = Counter()
    for name in ("gait", "gait-monocular"):
        problem = load_problem(name)
        words.update(verdict(problem, motions).word for motions in exact(problem, EXACT_SETS // 2))
    wrong = EXACT_SETS - words["right"] - words["undecided"]
    print(f"verdict_false_alarm: {wrong / EXACT_SETS:.3f}")
    print(f"verdict_right: {words['right'] / EXACT_SETS:.3f}", flush=True)


def measure_power() -> None:
    """Print how often faults are called by their name."""
    powers = []
    for name, word, fault in FAULTS:
        problem = load_problem(name)
        n = DRAWS if fault is not without_a_mode else 2 * DRAWS
        sets = exact(problem, FAULTY_SETS, n)
        named = [
            verdict(problem, fault(problem, motions, number)).word == word
            for number, motions in enumerate(sets)
        ]
        powers.append(float(np.mean(named)))
        print(f"verdict_power_{word.replace(' ', '_')}: {powers[-1]:.3f}", flush=True)
    print(f"verdict_power: {min(powers):.3f}", flush=True)


def measure_samplers() -> None:
    """Print the verdicts, over three seeds, on two samplers that must never be called right."""
    for name, sampler, settings in (
        ("gait", "dvae", {"training_steps": 1000, "training_pairs": 10_000}),
        ("gait-monocular", "ancestral3d", {}),
    ):
        problem = load_problem(name)
        for seed in range(3):
            draws = pm.sample(problem, sampler, draws=DRAWS, seed=seed, progress=False, **settings)
            judged = judge([draw_statistics(problem, draws, seed, chain_diagnostics(draws))])
            print(f"verdict_{sampler}_seed_{seed}: {judged}", flush=True)


PARTS: dict[str, Callable[[], None]] = {
    "demo": measure_demo,
    "import": measure_import,
    "score": measure_score,
    "exact": measure_exact,
    "power": measure_power,
    "samplers": measure_samplers,
}


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=list(PARTS), help="Parts to measure."
    )
    for part in parser.parse_args().parts:
        PARTS[part]()


if __name__ == "__main__":
    main()

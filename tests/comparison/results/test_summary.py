"""The summary of a comparison: sentences and the table of verdicts."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from probmotion.comparison.results import GridResults
from probmotion.comparison.results.failures import NOT_INSTALLED, Failure
from probmotion.comparison.results.run_results import RunResult
from probmotion.comparison.results.summary import problem_sentence, summary
from probmotion.metrics.verdict import Verdict

RIGHT = Verdict("right", "right", 200)
BUDGET = Failure("budget", "needs 9 seconds", True)
CRASH = Failure("KeyError", "no such key " + "x" * 200, False)


def undecided(n=200, needed=270):
    return Verdict("undecided", f"undecided at {n} draws (mean), about {needed} would decide", n)


def over(size="1.3"):
    return Verdict("overconfident", f"overconfident ×{size} and biased by 0.3 sd", 200)


MISSES = Verdict("misses modes", "misses modes: run 0.00 of 0.31 and overconfident ×7", 200)


@dataclass
class Results:
    """Verdicts, failures or None (no references) by problem and sampler, with seconds."""

    given: dict
    seconds: dict = field(default_factory=dict)
    metrics: dict = field(default_factory=dict)

    def __post_init__(self):
        names = dict.fromkeys(name for row in self.given.values() for name in row)
        self.plan = SimpleNamespace(
            problems=dict.fromkeys(self.given, ""),
            samplers=names,
            draws=200,
            budget="6 seconds per run",
            seeds=3,
        )
        self.results = [
            RunResult(
                problem,
                name,
                0,
                "",
                {} if isinstance(each, Failure) else self._metrics(name),
                each if isinstance(each, Failure) else None,
            )
            for problem, row in self.given.items()
            for name, each in row.items()
        ]

    def _metrics(self, name):
        return {"seconds": self.seconds.get(name, 6.0), **self.metrics.get(name, {})}

    def verdict(self, problem, sampler):
        each = self.given[problem].get(sampler)
        return Verdict("failed", "failed: why", 0) if isinstance(each, Failure) else each


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        (
            {"exact": RIGHT, "mas": over(), "mvpc": over(), "sds": MISSES, "nuts": RIGHT},
            "Take exact (right in 0.01 s) or nuts (right in 4.9 s). mas and mvpc are "
            "overconfident ×1.3; sds misses modes.",
        ),
        ({"stored": RIGHT, "nuts": RIGHT, "mh": RIGHT}, "Take nuts (right in 4.9 s)."),
        ({"exact": RIGHT, "stored": RIGHT}, "Take exact (right in 0.01 s) or stored (right)."),
        (
            {"sds": over("2.1"), "mas": MISSES, "mvpc": over(), "nuts": RIGHT, "dvae": BUDGET},
            "Take nuts (right in 4.9 s). sds and mvpc are overconfident ×1.3–2.1; "
            "mas misses modes.",
        ),
        (
            {"nuts": RIGHT, "exact": undecided(), "mine": CRASH},
            "Take nuts (right in 4.9 s). mine failed. exact is undecided at 200 draws "
            "(about 270 would decide).",
        ),
        (
            {"exact": undecided(), "nuts": undecided(180, 400), "sds": MISSES},
            "No sampler is shown to be right: exact and nuts are undecided at 180–200 draws "
            "(about 270–400 would decide). sds misses modes.",
        ),
        ({"sds": MISSES}, "No sampler is right. sds misses modes."),
        ({"sds": BUDGET}, "No sampler has draws."),
        ({"sds": None}, "No verdicts without reference draws."),
    ],
)
def test_sentence_names_the_cheapest_right_samplers_and_the_faults_of_others(row, sentence):
    results = Results({"p": row}, {"exact": 0.0123, "nuts": 4.92, "stored": 0.0})
    assert problem_sentence(results, "p") == sentence
    assert summary(results).startswith(f"p: {sentence[0].lower()}{sentence[1:20]}")


def test_problems_without_references_name_the_lowest_headline_metric():
    metrics = {"mas": {"fid": 24.1}, "mvpc": {"fid": 23.2}}
    results = Results({"p": {"mas": None, "mvpc": None, "nuts": BUDGET}}, metrics=metrics)
    assert problem_sentence(results, "p") == (
        "No verdicts without reference draws. Lowest Fréchet distance to held-out real views "
        "(FID): mvpc, 23.2 in 6 s."
    )


@pytest.mark.parametrize(("problems", "columns"), [(1, 3), (2, 5), (4, 5), (19, 0)])
def test_table_has_at_most_six_columns_and_a_row_per_sampler(problems, columns):
    row = {"exact": RIGHT, "mas": over(), "dvae": BUDGET, "nuts": undecided()}
    text = summary(Results({f"problem-{n}": row for n in range(problems)}))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 100
    *lines, gap, setup = text.splitlines()
    assert (gap, setup) == ("", "200 draws, 6 seconds per run, 3 seeds")
    table = lines[lines.index("") + 1 :] if columns else []
    assert ("" in lines) == bool(columns)
    if columns:
        assert len(table[0].split()) == columns
        assert [line.split()[0] for line in table] == ["sampler", *row]
        assert "overconfident ×1.3" in table[2]
        assert "no draws (budget)" in table[3]
        assert ("seconds" in table[0]) == (problems < 3)


def test_summary_of_the_demonstration_is_short():
    """The command adds a gap and three lines of paths to at most 25 lines."""
    differs = Verdict("differs", "differs: classifier accuracy 82%, not 50%", 400)
    row = {"ancestral3d": differs, "dvae": CRASH, "ensemble": undecided(), "exact": RIGHT}
    row |= {
        "mas": over(),
        "mh": undecided(90, 400),
        "mvpc": over("2"),
        "nuts": RIGHT,
        "sds": MISSES,
    }
    text = summary(Results({"gait": row, "gait-monocular": row}))
    assert len(text.splitlines()) <= 21
    assert max(map(len, text.splitlines())) <= 100


def test_failures_are_one_line_each_and_refusals_are_not_failures():
    row = {"nuts": RIGHT, "dvae": BUDGET, "mine": CRASH, "yours": CRASH}
    row |= {f"mine{n}": Failure("KeyError", f"no such key {n}", False) for n in range(3)}
    lines = summary(Results({"p": row})).splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[-4] == "mine and yours on p: no such key …"
    assert lines[-3] == "mine0 on p: no such key 0"
    assert "and 2 more failures, see failures.json" in lines
    assert not any(" on p: needs 9 seconds" in line for line in lines)


def test_missing_libraries_are_named_once_for_all_problems():
    missing = Failure(
        NOT_INSTALLED, "jax must be installed; run pip install 'probmotion[jax]'", False
    )
    row = {"exact": RIGHT, "nuts": missing, "smc": missing}
    lines = summary(Results({"p": row, "q": row})).splitlines()
    assert (
        lines.count("nuts and smc: jax must be installed; run pip install 'probmotion[jax]'") == 1
    )
    assert "failed (not installed)" in "".join(lines)


def test_comparison_prints_its_summary_and_writes_the_long_table(grid):
    text = str(grid)
    assert text == repr(grid) == grid.summary() == summary(grid)
    assert max(map(len, text.splitlines())) <= 100
    verdicts = grid.verdicts()
    for problem in ("generation", "monocular"):
        assert f"{problem}: " in text
        assert verdicts[problem]["crashing"].word == "failed"
    assert "failed (RuntimeError)" in text
    assert "no draws (observations)" in text
    written = (grid.folder / "table.txt").read_text(encoding="utf-8")
    assert written == f"{grid.table()}\n"
    assert verdicts["generation"]["exact"].sentence in written
    assert str(GridResults.load(grid.folder)) == text

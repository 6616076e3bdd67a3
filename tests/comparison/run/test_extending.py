"""A grid extends the folder of another one; runs that cannot share its table are refused."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest
from toy_samplers import SMALL, Failing, PriorDraws, Walking, count, generation, monocular, numbers

from probmotion.comparison import Budget, Comparison, compare
from probmotion.comparison.results import plan as plans
from probmotion.posteriors.draws import library_versions
from probmotion.samplers import ExactSampler


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def pairs(table: pd.DataFrame) -> set[tuple[str, str]]:
    return set(zip(table["problem"], table["sampler"], strict=True))


def test_subsets_leave_other_results_in_plan_table_and_report(tmp_path):
    out, diary = tmp_path / "out", tmp_path / "diary"
    toy = PriorDraws(diary=str(diary))
    first = compare(generation(), {"exact": ExactSampler(), "toy": toy}, seeds=2, out=out, **SMALL)
    compare(monocular(), {"exact": ExactSampler()}, out=out, **SMALL)
    # The sampler of the second call cannot be found by its name.
    last = compare(generation(), {"mine": PriorDraws(2.0)}, out=out, **SMALL)
    assert count(diary) == 2
    expected = {("generation", name) for name in ("exact", "toy", "mine")} | {
        ("monocular", "exact")
    }
    stored = pd.read_csv(out / "table.csv")
    assert pairs(stored) == pairs(pd.DataFrame(last.table())) == expected
    kept = stored[(stored["problem"] == "generation") & (stored["sampler"] != "mine")]
    assert numbers(kept) == numbers(first.table())
    plan = Comparison.load(out).plan
    assert list(plan.problems) == ["generation", "monocular"]
    assert list(plan.samplers) == ["exact", "toy", "mine"]
    assert plan.seeds == 2
    page = Comparison.load(out).report(tmp_path / "r.html").read_text()
    for name in ("generation", "monocular", "toy", "mine"):
        assert name in page


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"draws": 40}, "finished runs with draws 20 instead of 40"),
        ({"chains": 4}, "finished runs with chains 2 instead of 4"),
        ({"budget": Budget(seconds=3)}, "budget none instead of 3 seconds per run"),
        ({"samplers": {"toy": PriorDraws(2.0)}}, "finished runs of another sampler called toy"),
        ({"problems": {"generation": monocular()}}, "of another problem called generation"),
    ],
)
@pytest.mark.parametrize("other", [False, True], ids=["same address", "other address"])
def test_incompatible_runs_are_refused_and_change_nothing(change, message, other, tmp_path):
    """Even if the new runs have other addresses than the stored ones."""
    stored = {"problems": {"generation": generation()}, "samplers": {"toy": PriorDraws()}}
    compare(**stored, out=tmp_path, **SMALL)
    before = contents(tmp_path)
    given = stored | change
    if other and change.keys() != {"problems"}:
        given["problems"] = {"other": generation()}
    if other and change.keys() != {"samplers"}:
        given["samplers"] = {"another": PriorDraws()}
    with pytest.raises(ValueError, match=r"out must be a new folder, got .*, which contains ") as e:
        compare(**(SMALL | given), out=tmp_path)
    assert message in str(e.value)
    assert contents(tmp_path) == before


def test_other_library_versions_are_refused(tmp_path, monkeypatch):
    compare(generation(), PriorDraws(), out=tmp_path, **SMALL)
    versions = library_versions() | {"probmotion": "0.0.7"}
    monkeypatch.setattr(plans, "library_versions", lambda: versions)
    with pytest.raises(ValueError, match=r"finished runs with probmotion .* instead of 0\.0\.7"):
        compare(monocular(), ExactSampler(), out=tmp_path, **SMALL)


def test_a_folder_without_draws_accepts_other_settings(tmp_path):
    compare(generation(), {"a": Failing()}, out=tmp_path, **SMALL)
    compare(generation(), {"a": PriorDraws()}, out=tmp_path, **(SMALL | {"draws": 40}))
    plan = Comparison.load(tmp_path).plan
    assert (plan.draws, plan.samplers) == (40, {"a": {}})


def test_budget_notes_of_a_union_name_all_samplers(tmp_path):
    settings = {"budget": Budget(evaluations=500), "out": tmp_path, **SMALL}
    compare(generation(), {"free": PriorDraws()}, **settings)
    union = compare(generation(), {"walking": Walking(), "freer": PriorDraws(2.0)}, **settings)
    assert union.plan.notes[1:] == (
        "free, freer have no effort setting and ran with the given settings",
    )


def test_commands_of_a_union_are_joined(tmp_path, monkeypatch):
    for words in ("a --seeds 1", "b", "a --seeds 1"):
        monkeypatch.setattr("sys.argv", ["/bin/probmotion", "compare", *words.split()])
        compare({words[0]: generation()}, PriorDraws(), out=tmp_path, **SMALL)
    expected = "probmotion compare a --seeds 1 && probmotion compare b"
    assert Comparison.load(tmp_path).plan.command == expected


def test_simultaneous_grids_lose_nothing(tmp_path):
    problems = {name: generation() for name in "abcdef"}

    def run(name: str) -> Comparison:
        return compare({name: problems[name]}, ExactSampler(), out=tmp_path, **SMALL)

    with ThreadPoolExecutor(6) as executor:
        list(executor.map(run, problems))
    assert Comparison.load(tmp_path).plan.problems.keys() == problems.keys()
    assert set(pd.read_csv(tmp_path / "table.csv")["problem"]) == set(problems)

"""What a caller calls problems and samplers: odd names, and settings that are arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from toy_samplers import PriorDraws, generation, monocular

from probmotion.comparison import compare
from probmotion.comparison.results.naming import named_problems
from probmotion.comparison.results.plan import Plan
from probmotion.posteriors.problem import Problem
from probmotion.problems import load_problem
from probmotion.samplers import MultiViewAncestral


def settings_of(sampler: Any) -> dict[str, str]:
    return Plan.of({}, {"it": sampler}, draws=10, chains=1, seeds=1).samplers["it"]


@pytest.mark.parametrize("name", ["gait(mine)", "gait(frames=2, mine=3)", "gait(frames=0)", "gait"])
def test_a_problem_of_one_s_own_may_be_called_like_a_registered_one(name):
    mine = replace(generation(), name=name)
    assert named_problems(mine) == {name: mine}
    found = compare(mine, PriorDraws(), draws=10, chains=1, workers=0, progress=False)
    assert found.failures == []
    assert set(found.table()["problem"]) == {name}


def test_a_problem_whose_namesake_s_data_is_not_there_is_one_s_own(monkeypatch):
    def absent(name: str) -> Problem:
        raise FileNotFoundError(f"{name} needs data")

    monkeypatch.setattr("probmotion.comparison.results.naming.load_problem", absent)
    mine = replace(generation(), name="gait")
    assert named_problems(mine) == {"gait": mine}


def test_a_registered_problem_still_travels_by_its_name():
    scaled = load_problem("gait", frames=8)
    assert named_problems([load_problem("gait"), scaled]) == {
        "gait": "gait",
        scaled.name: scaled.name,
    }


def test_a_setting_that_is_an_array_is_listed_as_changed():
    sampler = MultiViewAncestral(view_weights=np.ones(5))
    assert settings_of(sampler) == {"view_weights": repr(np.ones(5))}


@dataclass(frozen=True)
class WithArrays:
    name: ClassVar[str] = "with-arrays"
    requires: ClassVar[tuple[type, ...]] = ()

    numbers: Any = field(default_factory=lambda: np.arange(3000.0))
    several: Any = field(default_factory=lambda: (np.ones(2), np.zeros(3)))
    tensor: Any = field(default_factory=lambda: torch.ones(4))
    scale: float = 2.0


NUMBERS = np.arange(3000.0)
CHANGED = NUMBERS.copy()
CHANGED[1500] = 0  # Where a printed array says "...".


@pytest.mark.parametrize(
    ("given", "changed"),
    [
        ({}, []),
        ({"numbers": NUMBERS.copy(), "tensor": torch.ones(4)}, []),
        ({"several": (np.ones(2), np.zeros(3))}, []),
        ({"numbers": CHANGED}, ["numbers"]),
        ({"numbers": np.ones(2)}, ["numbers"]),
        ({"numbers": None, "tensor": None}, ["numbers", "tensor"]),
        ({"several": (np.ones(2), np.ones(3))}, ["several"]),
        ({"tensor": torch.zeros(4)}, ["tensor"]),
        # As before, an integer is the number that it stands for.
        ({"scale": 2}, []),
        ({"scale": 3}, ["scale"]),
    ],
)
def test_arrays_are_told_apart_by_what_they_hold(given, changed):
    assert list(settings_of(WithArrays(**given))) == changed


def test_names_are_no_longer_than_a_folder_s():
    with pytest.raises(ValueError, match=r"problems has a name of 400 bytes, ää.*, expected at"):
        named_problems({200 * "ä": monocular()})
    assert list(named_problems({200 * "a": monocular()})) == [200 * "a"]


def test_a_registered_problem_has_one_name_however_it_is_written():
    ways = "gait-monocular(noise=0.1, frames=4)", "gait-monocular(frames=4, noise=0.1)"
    assert list(named_problems(ways[0])) == list(named_problems(ways[1])) == [ways[1]]
    with pytest.raises(ValueError, match="problems has two called 'gait-monocular"):
        named_problems(ways)

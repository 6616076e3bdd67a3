"""Names of problems and samplers, and settings that differ from the defaults."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from toy_samplers import generation, monocular

from probmotion.comparison.results.naming import named_problems
from probmotion.comparison.results.plan import Plan
from probmotion.problems import load_problem
from probmotion.samplers import MultiViewAncestral


def settings_of(sampler: Any) -> dict[str, str]:
    return Plan.of({}, {"a": sampler}, draws=10, chains=1, seeds=1).samplers["a"]


@pytest.mark.parametrize("name", ["gait(mine)", "gait(frames=2, mine=3)", "gait(frames=0)", "gait"])
def test_user_problems_may_have_the_name_of_a_registered_one(name):
    mine = replace(generation(), name=name)
    assert named_problems(mine) == {name: mine}


def test_user_problems_need_no_data_of_a_registered_namesake(monkeypatch):
    absent = Mock(side_effect=FileNotFoundError("gait needs data"))
    monkeypatch.setattr("probmotion.comparison.results.naming.load_problem", absent)
    mine = replace(generation(), name="gait")
    assert named_problems(mine) == {"gait": mine}


def test_registered_problems_are_sent_by_their_full_name():
    scaled = load_problem("gait", frames=8)
    names = {"gait": "gait", scaled.name: scaled.name}
    assert named_problems([load_problem("gait"), scaled]) == names
    ways = "gait-monocular(noise=0.1, frames=4)", "gait-monocular(frames=4, noise=0.1)"
    assert list(named_problems(ways[0])) == list(named_problems(ways[1])) == [ways[1]]
    with pytest.raises(ValueError, match="must have different names, got 'gait-monocular"):
        named_problems(ways)


def test_names_are_limited_to_200_bytes():
    with pytest.raises(ValueError, match="names of problems must have at most 200 bytes, got 400"):
        named_problems({200 * "ä": monocular()})
    assert list(named_problems({200 * "a": monocular()})) == [200 * "a"]


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
CHANGED[1500] = 0  # where a printed array shows "..."


@pytest.mark.parametrize(
    ("given", "changed"),
    [
        ({}, []),
        ({"numbers": NUMBERS.copy(), "tensor": torch.ones(4)}, []),
        ({"several": (np.ones(2), np.zeros(3))}, []),
        ({"numbers": CHANGED}, ["numbers"]),
        ({"numbers": None, "tensor": None}, ["numbers", "tensor"]),
        ({"several": (np.ones(2), np.ones(3))}, ["several"]),
        ({"tensor": torch.zeros(4)}, ["tensor"]),
        ({"scale": 3}, ["scale"]),
    ],
)
def test_changed_settings_compare_arrays_by_their_contents(given, changed):
    assert list(settings_of(WithArrays(**given))) == changed
    sampler = MultiViewAncestral(view_weights=np.ones(5))
    assert settings_of(sampler) == {"view_weights": repr(np.ones(5))}

"""Progress of a grid: a bar on a terminal, a line per finished run elsewhere, or silence."""

from __future__ import annotations

import io
import re
import sys
from unittest.mock import Mock

import pytest
from toy_samplers import SMALL, Failing, PriorDraws, Walking, generation, monocular

from probmotion.comparison import Budget, compare
from probmotion.comparison.run import progress
from probmotion.comparison.run.progress import _rounded

SETTINGS = SMALL | {"progress": True}
LINE = re.compile(
    r"\[(\d)/4\] (generation|monocular) (toy|failing) seed 0: "
    r"(\d+\.\d s|failed, RuntimeError|unsupported, observations)(, about \d+ s left)?"
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("workers", [0, 2])
def test_without_a_terminal_every_finished_run_is_a_line(workers, capsys):
    problems = [generation(), monocular()]
    samplers = {"toy": PriorDraws(), "failing": Failing()}
    compare(problems, samplers, **SETTINGS | {"workers": workers})
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "\r" not in printed.err
    matches = [LINE.fullmatch(line) for line in printed.err.splitlines()]
    assert all(matches), printed.err
    assert [match[1] for match in matches] == list("1234")
    assert [match[5] is not None for match in matches] == [True, True, True, False]
    outcomes = {(match[2], match[3]): match[4] for match in matches}
    assert outcomes["generation", "failing"] == "failed, RuntimeError"
    assert outcomes["monocular", "toy"] == "unsupported, observations"


def test_pilots_have_one_line(capsys):
    compare(generation(), Walking(), budget=Budget(evaluations=500), seeds=2, **SETTINGS)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "1 pilots choose settings within the budget"
    assert [line.partition(":")[0] for line in lines[1:]] == [
        "[1/2] generation walking seed 0",
        "[2/2] generation walking seed 1",
    ]


def test_seconds_left_are_those_of_the_remaining_runs(capsys, monkeypatch):
    clock = Mock(monotonic=Mock(side_effect=[100.0, 110.0, 140.0, 150.0]))
    monkeypatch.setattr(progress, "time", clock)
    compare(generation(), PriorDraws(), seeds=3, **SETTINGS)
    left = [line.partition(" s, ")[2] for line in capsys.readouterr().err.splitlines()]
    assert left == ["about 20 s left", "about 20 s left", ""]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_terminal_has_one_bar(workers, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    compare(generation(), {"toy": PriorDraws()}, seeds=2, **SETTINGS | {"workers": workers})
    shown = sys.stderr.getvalue()
    assert "\n" not in shown
    last = shown.rstrip("\r ").rpartition("\r")[2]
    assert re.match(r"runs: generation toy .* 2/2, about 00:00 left", last), shown


def test_nothing_is_printed_without_progress(capsys, monkeypatch):
    compare(generation(), PriorDraws(), **SMALL)
    monkeypatch.setattr(sys, "stderr", Terminal())
    compare(generation(), PriorDraws(), **SMALL)
    assert sys.stderr.getvalue() == capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0 s"), (99.4, "99 s"), (99.6, "2 min"), (7200.0, "2 h")]
)
def test_durations_are_rounded(seconds, text):
    assert _rounded(seconds) == text

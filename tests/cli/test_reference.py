"""The command ``probmotion reference``: what it writes, and that it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from probmotion.cli.main import main
from probmotion.posteriors.reference import StoredReference
from probmotion.problems import load_problem
from probmotion.problems.references import making as references

SMALL = "gait-sparse(frames=2, components=6)"


def test_it_writes_draws_and_their_certificate(tmp_path, capsys):
    words = ["reference", "gait-sparse(components=6,frames=2)", "--draws", "80"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    assert "two runs apart: sliced Wasserstein ratio" in capsys.readouterr().out
    kept = StoredReference.load(tmp_path / SMALL)
    assert (kept.n, kept.certificate["exact"]) == (80, True)
    assert json.loads((tmp_path / SMALL / "certificate.json").read_text())["problem"] == SMALL
    kept.check(SMALL, load_problem(SMALL).posterior)
    with pytest.raises(ValueError, match="another posterior"):
        kept.check(SMALL, load_problem(SMALL, noise=0.04).posterior)


def test_by_default_they_are_where_comparisons_look(tmp_path, monkeypatch):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    assert main(["reference", SMALL, "--draws", "80"]) == 0
    assert (tmp_path / "references" / SMALL / "draws.npz").is_file()


def test_runs_that_disagree_end_with_status_2_and_keep_nothing(tmp_path, capsys, monkeypatch):
    made = references._run

    def narrow(problem, sampler, n, seed, half, progress, unfinished):
        run = made(problem, sampler, n, seed, half, progress, unfinished)
        positions = run.dataset["positions"]
        if half:
            run.dataset["positions"] = positions.mean() + 0.9 * (positions - positions.mean())
        return run

    monkeypatch.setattr(references, "_run", narrow)
    assert main(["reference", SMALL, "--draws", "80", "--out", str(tmp_path)]) == 2
    assert "disagree" in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_stopped_in_its_second_run_it_goes_on_there(tmp_path, capsys, monkeypatch):
    made, asked = references._run, []

    def stopped(problem, sampler, n, seed, half, progress, unfinished):
        asked.append((seed, half))
        if len(asked) in (2, 3):
            raise KeyboardInterrupt
        return made(problem, sampler, n, seed, half, progress, unfinished)

    monkeypatch.setattr(references, "_run", stopped)
    words = ["reference", SMALL, "--draws", "80", "--out", str(tmp_path)]
    assert main(words) == 130
    assert "what was made is kept, and the same command goes on" in capsys.readouterr().err
    # Others neither find it nor take it away, whether they are stopped or end.
    assert main([*words, "--seed", "1"]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert main([*words, "--seed", "1"]) == 0
    assert main(words) == 0
    assert asked == [(0, 0), (0, 1), (1, 0), (1, 0), (1, 1), (0, 1)]
    assert [path.name for path in tmp_path.iterdir()] == [SMALL]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["gate"], "problem must be one of, got 'gate'"),
        ([SMALL, "--draws", "81"], "draws must be a multiple of 8, got 81"),
        (["walk2d"], "MotionDiffusion has no density, expected one of positions"),
    ],
)
def test_wrong_words_get_one_sentence(words, sentence, tmp_path, capsys):
    assert main(["reference", *words, "--out", str(tmp_path)]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_draws_are_float32_numbers(tmp_path):
    main(["reference", SMALL, "--draws", "80", "--out", str(tmp_path)])
    with np.load(tmp_path / SMALL / "draws.npz", allow_pickle=False) as held:
        assert held["positions"].dtype == np.float32

"""``probmotion reference``: files, resuming and error messages."""

import json

import numpy as np
import pytest

from probmotion.cli.main import main
from probmotion.posteriors.reference import StoredReference
from probmotion.problems import load_problem
from probmotion.problems.references import making as references

SMALL = "gait-sparse(frames=2, components=6)"


def test_reference_writes_draws_and_their_certificate(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    assert main(["reference", "gait-sparse(components=6,frames=2)", "--draws", "80"]) == 0
    assert "agreement of two runs: sliced Wasserstein ratio" in capsys.readouterr().out
    folder = tmp_path / "references" / SMALL
    stored = StoredReference.load(folder)
    assert (stored.n, stored.certificate["exact"]) == (80, True)
    assert json.loads((folder / "certificate.json").read_text())["problem"] == SMALL
    stored.check(SMALL, load_problem(SMALL).posterior)
    with pytest.raises(ValueError, match="fingerprint"):
        stored.check(SMALL, load_problem(SMALL, noise=0.04).posterior)
    with np.load(folder / "draws.npz", allow_pickle=False) as archive:
        assert archive["positions"].dtype == np.float32


def test_disagreeing_runs_fail_and_write_nothing(tmp_path, capsys, monkeypatch):
    original = references._run

    def narrowed(problem, sampler, n, seed, half, *rest):
        run = original(problem, sampler, n, seed, half, *rest)
        positions = run.dataset["positions"]
        if half:
            run.dataset["positions"] = positions.mean() + 0.9 * (positions - positions.mean())
        return run

    monkeypatch.setattr(references, "_run", narrowed)
    assert main(["reference", SMALL, "--draws", "80", "--out", str(tmp_path)]) == 2
    assert "two runs" in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_interrupted_command_continues_after_the_first_run(tmp_path, capsys, monkeypatch):
    original, calls = references._run, []

    def stopped(problem, sampler, n, seed, half, *rest):
        calls.append((seed, half))
        if len(calls) in (2, 3):
            raise KeyboardInterrupt
        return original(problem, sampler, n, seed, half, *rest)

    monkeypatch.setattr(references, "_run", stopped)
    words = ["reference", SMALL, "--draws", "80", "--out", str(tmp_path)]
    assert main(words) == 130
    assert "finished runs are stored, repeat the command to continue" in capsys.readouterr().err
    # Other seeds neither use nor delete the stored run, interrupted or not.
    assert main([*words, "--seed", "1"]) == 130
    assert "nothing more was written" in capsys.readouterr().err
    assert main([*words, "--seed", "1"]) == 0
    assert main(words) == 0
    assert calls == [(0, 0), (0, 1), (1, 0), (1, 0), (1, 1), (0, 1)]
    assert [path.name for path in tmp_path.iterdir()] == [SMALL]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["gate"], "got 'gate'"),
        ([SMALL, "--draws", "81"], "draws must be a multiple of 8"),
        (["walk2d"], "MotionDiffusion"),
    ],
)
def test_invalid_options_give_one_error_line(words, expected, tmp_path, fails):
    assert expected in fails("reference", *words, "--out", tmp_path)
    assert not list(tmp_path.iterdir())

"""Fixtures of the command-line tests."""

import os
import signal
import subprocess
import sys
import time

import pytest

from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import save


@pytest.fixture
def fails(capsys):
    """Return a function that runs a failing command and returns its one-line error message."""

    def run(*words):
        assert main([str(word) for word in words]) == 2, words
        lines = capsys.readouterr().err.splitlines()
        (line,) = (line for line in lines if line.startswith("probmotion: "))
        return line.removeprefix("probmotion: ")

    return run


@pytest.fixture(scope="session")
def interrupted():
    """Return a function that interrupts a command once a path exists and returns its message."""
    script = "import sys; from probmotion.cli.main import main; sys.exit(main())"

    def run(words, path):
        process = subprocess.Popen(
            [sys.executable, "-c", script, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, start_new_session=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        limit = time.monotonic() + 60
        while not path.exists() and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)  # to the whole process group, as a terminal does
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 130
        assert "Traceback" not in errors
        (line,) = (line for line in errors.splitlines() if line.startswith("probmotion: "))
        return line

    return run


@pytest.fixture(scope="session")
def write_walks():
    """Return a function that writes walk0.npz, walk1.npz, … and returns their pattern."""

    def write(folder, n=5, frames=40, fps=30.0):
        folder.mkdir(exist_ok=True)
        for number in range(n):
            save(make_gait("walk", number, frames=frames, fps=fps), folder / f"walk{number}.npz")
        return str(folder / "walk*.npz")

    return write


@pytest.fixture(scope="session")
def walks(write_walks, tmp_path_factory):
    """File name pattern of five clips of two seconds."""
    return write_walks(tmp_path_factory.mktemp("walks"), frames=60)

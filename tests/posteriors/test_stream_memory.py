"""Memory of a long streamed chain, as measured by ``benchmarks/streaming.py``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "streaming.py"


@pytest.mark.slow
def test_a_million_draws_are_streamed_in_little_memory():
    """10⁶ draws of a chain in 150 dimensions, 1.12 GiB of θ alone, in 1.5 GiB in all."""
    # The peak that a process reports includes that of the process that started it, here a shell.
    command = ["sh", "-c", '"$0" "$@"; exit $?', sys.executable, BENCHMARK, "--many"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    values = dict(line.split(": ") for line in printed.splitlines())
    assert int(values["stream_draws"]) == 10**6
    assert float(values["stream_rhat"]) > 0
    assert float(values["stream_peak_gib"]) < 1.5

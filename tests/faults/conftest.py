"""Number of faults of the campaign, their account, and a disk that fills up."""

from __future__ import annotations

import os
import subprocess
from collections import Counter
from contextlib import contextmanager

import pytest

OUTCOMES = ("tried", "survived", "lost")


def pytest_terminal_summary(terminalreporter):
    """Print how many faults were tried, survived and lost."""
    counted = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            # Processes of pytest-xdist send the properties of their tests.
            for name, entry in getattr(report, "user_properties", ()):
                if name == "fault" and getattr(report, "when", "") == "call":
                    counted[tuple(entry)] += 1
    if not counted:
        return
    rows = sorted({(fault, target) for fault, target, _ in counted})
    terminalreporter.section("faults")
    width, wide = (max(len(row[place]) for row in rows) for place in (0, 1))
    titles = "".join(f"{outcome:>10}" for outcome in OUTCOMES)
    terminalreporter.write_line(f"{'fault':{width}}  {'target':{wide}}{titles}")
    for fault, target in [*rows, ("all", "")]:
        numbers = Counter()
        for (of, at, outcome), number in counted.items():
            if fault == "all" or (of, at) == (fault, target):
                numbers[outcome] += number
                numbers["tried"] += number
        columns = "".join(f"{numbers[outcome]:>10}" for outcome in OUTCOMES)
        terminalreporter.write_line(f"{fault:{width}}  {target:{wide}}{columns}")


@pytest.fixture
def account(request):
    """Return a context manager that records whether a block survives a fault."""

    @contextmanager
    def attempt(fault, target):
        outcome = "lost"
        try:
            yield
            outcome = "survived"
        finally:
            request.node.user_properties.append(("fault", (fault, target, outcome)))

    return attempt


@pytest.fixture(scope="session")
def moments():
    """Number of random moments per target."""
    return int(os.environ.get("PROBMOTION_FAULTS", "2"))


@pytest.fixture
def disk(tmp_path):
    """Mount a disk of 20 MB; return its folder."""
    if os.name != "posix" or os.geteuid() != 0:
        pytest.skip("only root can mount a disk of 20 MB")
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(folder)]
    mounted = subprocess.run(mount, capture_output=True, text=True, check=False)
    if mounted.returncode:
        pytest.skip(f"a disk of 20 MB cannot be mounted: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)

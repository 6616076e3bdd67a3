"""The scripts of docs/how-to/cluster.md on Dask, MPI and a batch queue: identical tables."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

import probmotion as pm

pytestmark = [
    pytest.mark.slow,
    # Dask has its own event loop and connections.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "how-to" / "cluster.md").read_text(encoding="utf-8")
GRID = ("gait(frames=6)", ["exact", "ancestral3d", "mh"])
SETTINGS = {"draws": 20, "seeds": 2, "progress": False}
TIMEOUT = 600  # seconds, on a busy machine
COMPARED = ('["gait", "gait-monocular"]', f"*{GRID!r}, **{SETTINGS!r}")


@pytest.fixture(scope="module")
def expected():
    return numbers(pm.compare(*GRID, **SETTINGS))


def numbers(comparison):
    table = comparison.table()
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].to_csv(index=False)


def blocks(section, language):
    """Return the code of a section of the page."""
    (text,) = re.findall(rf"^## {section}\n(.*?)(?=^## )", PAGE, flags=re.DOTALL | re.MULTILINE)
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)


def changed(code, *replacements):
    for old, new in replacements:
        assert code.count(old) == 1, old
        code = code.replace(old, new)
    return code


@contextmanager
def started(command, folder):
    """Start a command of the page in ``folder``, and end it and its children."""
    words = command.split()
    # ``python`` and ``dask`` are those of the tests.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    words[0] = shutil.which(words[0], path=path) or words[0]
    with (folder / f"{Path(words[0]).name}-{time.monotonic_ns()}.log").open("w+") as log:
        process = subprocess.Popen(
            words, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            yield process, lambda: Path(log.name).read_text(encoding="utf-8")
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGTERM)
                process.wait(timeout=TIMEOUT)


def finish(script, folder, command="python run.py"):
    """Run a script of the page with a command to its end; return its comparison and output."""
    (folder / "run.py").write_text(script, encoding="utf-8")
    with started(command, folder) as (process, output):
        assert process.wait(timeout=TIMEOUT) == 0, output()
    return pm.Comparison.load(folder / "results"), output()


def test_dask_with_a_killed_worker(expected, tmp_path):
    distributed = pytest.importorskip("distributed")
    scheduler, worker = blocks("Dask", "sh")
    (script,) = blocks("Dask", "python")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    here = ("HOST:8786", f"127.0.0.1:{port}")
    local = ("8786", f"{port} --host 127.0.0.1 --no-dashboard")
    few = ("--nworkers 8", "--nworkers 2 --no-dashboard")
    (tmp_path / "run.py").write_text(changed(script, here, COMPARED), encoding="utf-8")
    with (
        started(changed(scheduler, local), tmp_path),
        started(changed(worker, here, few), tmp_path),
        distributed.Client(f"tcp://127.0.0.1:{port}", timeout=TIMEOUT) as client,
    ):
        client.wait_for_workers(2, timeout=TIMEOUT)
        workers = set(client.run(os.getpid).values())
        assert len(workers) == 2
        with started("python run.py", tmp_path) as (process, output):
            while not list(tmp_path.rglob("run.json")):
                assert process.poll() is None, output()
                time.sleep(0.01)
            os.kill(min(workers), signal.SIGKILL)
            assert process.wait(timeout=TIMEOUT) == 0, output()
        client.wait_for_workers(2, timeout=TIMEOUT)
        assert len(workers & set(client.run(os.getpid).values())) == 1
    assert numbers(pm.Comparison.load(tmp_path / "results")) == expected


@pytest.mark.skipif(not shutil.which("mpiexec"), reason="mpiexec is not installed")
def test_mpi(expected, tmp_path):
    pytest.importorskip("mpi4py")
    (command,), (script,) = blocks("MPI", "sh"), blocks("MPI", "python")
    few = ("mpiexec -n 9", "mpiexec --allow-run-as-root --oversubscribe -n 3")
    # Processes that do not find each other would each compute everything.
    start = "as executor:\n"
    counted = (start, f'{start}        print("workers:", executor.num_workers)\n')
    comparison, output = finish(changed(script, COMPARED, counted), tmp_path, changed(command, few))
    assert re.findall("workers: .*", output) == ["workers: 2"]
    assert numbers(comparison) == expected


def test_slurm(expected, tmp_path):
    """Dask-jobqueue's local queue starts the scripts that its SLURMCluster would submit."""
    pytest.importorskip("dask_jobqueue")
    (script,) = blocks("Slurm", "python")
    imported = "from dask_jobqueue import SLURMCluster"
    local = "from dask_jobqueue.local import LocalCluster as SLURMCluster"
    assert f"replace `{imported}` with\n`{local}`" in PAGE
    few = ("n_workers=8", "n_workers=2")
    comparison, _ = finish(changed(script, (imported, local), few, COMPARED), tmp_path)
    assert numbers(comparison) == expected

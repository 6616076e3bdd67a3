"""The same comparison on Dask, MPI and a batch queue, as on a cluster: identical tables."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest

import probmotion as pm

pytestmark = [
    pytest.mark.slow,
    # Dask has its own event loop and connections.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

GRID = ("gait(frames=6)", ["exact", "ancestral3d", "mh"])
SETTINGS = {"draws": 20, "seeds": 2, "progress": False}
MPI = """
import sys
import probmotion as pm
from mpi4py.futures import MPIPoolExecutor

if __name__ == "__main__":
    with MPIPoolExecutor() as executor:
        print(f"workers: {executor.num_workers}")
        pm.compare(*GRID, **SETTINGS, executor=executor, out=sys.argv[1])
"""


@pytest.fixture(scope="module")
def expected():
    return numbers(pm.compare(*GRID, **SETTINGS))


def numbers(comparison):
    table = comparison.table()
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].to_csv(index=False)


def test_dask_with_a_killed_worker(expected, tmp_path):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
    )
    killed = []

    def kill_one_after_the_first_run(workers):
        while not list(tmp_path.rglob("run.json")):
            time.sleep(0.01)
        os.kill(workers[0], signal.SIGKILL)
        killed.append(workers[0])

    with cluster, distributed.Client(cluster) as client, client.get_executor() as executor:
        workers = list(client.run(os.getpid).values())
        assert len(set(workers) - {os.getpid()}) == 2
        killer = threading.Thread(target=kill_one_after_the_first_run, args=[workers])
        killer.start()
        comparison = pm.compare(*GRID, **SETTINGS, executor=executor, out=tmp_path)
        killer.join()
    assert killed
    assert numbers(comparison) == expected


@pytest.mark.skipif(not shutil.which("mpiexec"), reason="mpiexec is not installed")
def test_mpi(expected, tmp_path):
    pytest.importorskip("mpi4py")
    script = tmp_path / "run.py"
    script.write_text(f"GRID, SETTINGS = {GRID!r}, {SETTINGS!r}\n{MPI}")
    command = ["mpiexec", "--allow-run-as-root", "--oversubscribe", "-n", "3", sys.executable]
    command += ["-m", "mpi4py.futures", str(script), str(tmp_path / "out")]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert ran.stdout == "workers: 2\n"
    assert numbers(pm.Comparison.load(tmp_path / "out")) == expected


def test_batch_queue(expected, tmp_path):
    """Dask-jobqueue's local queue starts the scripts that its SLURMCluster would submit."""
    queue = pytest.importorskip("dask_jobqueue.local")
    distributed = pytest.importorskip("distributed")
    cluster = queue.LocalCluster(
        cores=1, processes=1, memory="2GB", n_workers=2, log_directory=tmp_path / "logs"
    )
    with cluster, distributed.Client(cluster) as client, client.get_executor() as executor:
        comparison = pm.compare(*GRID, **SETTINGS, executor=executor, out=tmp_path / "out")
    assert numbers(comparison) == expected

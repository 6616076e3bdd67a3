"""Cells run on any executor, with the same table."""

from __future__ import annotations

import logging
import os
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from threading import Timer

import pandas as pd
import pytest
from toy_samplers import Crashing, PriorDraws, generation, monocular

from probmotion.comparison import Budget, compare
from probmotion.comparison.results.failures import CellNotKept

SMALL = {"draws": 20, "chains": 2, "seeds": 2, "workers": 0, "progress": False}
SAMPLERS = {"toy": PriorDraws(), "wide": PriorDraws(2.0), "crashing": Crashing()}


def numbers(comparison):
    table = pd.DataFrame(comparison.table())
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].to_csv(index=False)


@pytest.fixture(scope="module")
def here():
    return numbers(compare([generation(), monocular()], SAMPLERS, **SMALL))


# Its event loop and its lost connections are its own.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_dask_in_processes(here, tmp_path):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address=None,
        silence_logs=logging.CRITICAL,
    )
    with cluster, distributed.Client(cluster) as client, client.get_executor() as executor:
        workers = set(client.run(os.getpid).values())
        assert len(workers - {os.getpid()}) == 2
        problems = [generation(), monocular()]
        found = compare(problems, SAMPLERS, executor=executor, out=tmp_path, **SMALL)
    assert numbers(found) == here


def test_threads_with_a_limit_and_a_budget(here):
    settings = {**SMALL, "budget": Budget(evaluations=500), "time_limit": 100.0}
    with ThreadPoolExecutor(2) as executor:
        there = compare(generation(), SAMPLERS, executor=executor, **settings)
    assert numbers(there) == numbers(compare(generation(), SAMPLERS, **settings))


class _Broken(ThreadPoolExecutor):
    """Loses every task to an error of its own."""

    error: Exception = OSError("the cluster is gone")

    def submit(self, function, *arguments, **settings):
        future = Future()
        future.set_exception(self.error)
        return future


def test_what_an_executor_loses_is_a_row():
    with _Broken() as executor:
        found = compare(generation(), SAMPLERS, executor=executor, **SMALL)
    assert {result.failure.message for result in found.results} == {"the cluster is gone"}
    assert len(found.results) == 6


class _Choosy(ThreadPoolExecutor):
    """Refuses one sampler's tasks."""

    def submit(self, function, task, **settings):
        if task.sampler == "wide":
            raise TypeError("wide cannot be sent")
        return super().submit(function, task, **settings)


def test_what_an_executor_does_not_take_is_a_row_and_the_rest_runs():
    with _Choosy() as executor:
        found = compare(generation(), SAMPLERS, executor=executor, **SMALL)
    words = {
        (result.sampler, result.failure and result.failure.message) for result in found.results
    }
    assert words == {
        ("toy", None), ("wide", "wide cannot be sent"), ("crashing", "the floor gave way")
    }  # fmt: skip


class _Forgetful(ThreadPoolExecutor):
    """Ends every task without a word, and without having done anything."""

    def submit(self, function, *arguments, **settings):
        future = Future()
        future.set_result(None)
        return future


def test_what_workers_keep_where_nobody_sees_it_is_a_row():
    with _Forgetful() as executor:
        found = compare(generation(), SAMPLERS, executor=executor, **SMALL)
    assert len(found.results) == 6
    for result in found.results:
        assert result.failure.word == "FileNotFoundError"
        assert "expected workers that see out" in result.failure.message


def test_workers_in_another_folder_keep_cells_where_they_belong(here, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    workers = ProcessPoolExecutor(
        1, get_context("spawn"), initializer=os.chdir, initargs=[tmp_path / "elsewhere"]
    )
    with workers as executor:
        found = compare([generation(), monocular()], SAMPLERS, executor=executor, out="o", **SMALL)
    assert numbers(found) == here
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_full_disk_on_an_executor_stops_the_run():
    with _Broken() as executor:
        executor.error = CellNotKept("No space left on device")
        with pytest.raises(OSError, match="any more, No space left on device, with 0 of 6 cells"):
            compare(generation(), SAMPLERS, executor=executor, **SMALL)


def test_what_was_cancelled_with_its_executor_is_a_row():
    executor = ThreadPoolExecutor(1)
    slow = {"first": PriorDraws(nap=0.5), "second": PriorDraws(), "third": PriorDraws()}
    shut = Timer(0.2, executor.shutdown, kwargs={"wait": False, "cancel_futures": True})
    shut.start()
    found = compare(generation(), slow, executor=executor, **(SMALL | {"seeds": 1}))
    shut.join()
    said = [result.failure and result.failure.message for result in found.results]
    assert said == [None, *2 * ["the executor cancelled it"]]


def test_a_class_of_executors_is_none():
    with pytest.raises(ValueError, match=r"executor is <class .*>, expected one that has submit"):
        compare(generation(), PriorDraws(), executor=ThreadPoolExecutor, **SMALL)

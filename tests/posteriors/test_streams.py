"""Draws written as they come: equal to those of one run, whatever interrupts the writing."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
import zarr

import probmotion as pm
from probmotion.files import locked_folder
from probmotion.posteriors import streams
from probmotion.posteriors.sampling import Interrupted
from tests.samplers.test_determinism import RIVALS, quick
from tests.samplers.test_protocol import QUICK

SAMPLERS = {
    "mh": pm.samplers.MetropolisHastings(warmup=20, thin=1),
    "smc": pm.samplers.SequentialMonteCarlo(particles=20, candidates=40, thin=1, gradients=False),
    "tempered": pm.samplers.ParallelTempering(warmup=5, thin=1, particles=16, gradients=False),
    "ancestral3d": pm.samplers.Ancestral3D(steps=5, batch=4),
}
OTHERS = [name for name in [*QUICK, *RIVALS] if name not in SAMPLERS]
RUN = {"draws": 40, "chains": 2, "seed": 3, "progress": False}


@pytest.fixture(scope="module")
def posterior():
    return pm.problem("gait-monocular", frames=6).posterior


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Let a run of 40 draws have several blocks, the last of them incomplete."""
    monkeypatch.setattr(streams, "_BLOCK_BYTES", 80_000)


@pytest.mark.parametrize(
    "name", [*SAMPLERS, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
)
def test_streamed_draws_equal_those_of_one_run(name, posterior, tmp_path):
    sampler = SAMPLERS.get(name) or quick(name)
    if name == "sds":
        posterior = pm.MotionPosterior(posterior.prior)
    assert 1 < 40 / streams._block(posterior, 2) != 40 // streams._block(posterior, 2)
    streams.stream_draws(sampler, posterior, tmp_path, **{**RUN, "draws": 25})
    streamed = streams.stream_draws(sampler, posterior, tmp_path, **RUN)
    once = sampler.sample(posterior, **RUN)
    tolerance = 1e-9 if once.independent else 0  # rounding depends on the place in a batch
    for key, values in once.dataset.data_vars.items():
        if values.dims[:2] == ("chain", "draw"):
            np.testing.assert_allclose(streamed.dataset[key], values, rtol=0, atol=tolerance)
            # Zarr's fill value, 0, is no missing value.
            assert streamed.dataset[key].dtype == values.dtype
    # Each of the four blocks trains the network of dvae.
    blocks = 4 if name == "dvae" else 1
    assert streamed.counts == {key: blocks * count for key, count in once.counts.items()}
    assert streamed.skeleton == once.skeleton
    again = streams.stream_draws(sampler, posterior, tmp_path, **{**RUN, "draws": 10})
    np.testing.assert_array_equal(again.positions, streamed.positions[:, :10])


def test_chunks_are_those_that_zarr_writes(posterior, tmp_path, monkeypatch):
    """Also where a run is extended within a chunk, and in the last, incomplete chunk."""
    monkeypatch.setattr(streams, "_BLOCK_BYTES", 320_000)
    for draws in (5, 13, 40):
        run = {**RUN, "draws": draws}
        streamed = streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **run)
    ours = zarr.open_group(tmp_path / "draws.zarr", mode="r")
    theirs = zarr.open_group(tmp_path / "zarr", mode="w", zarr_format=2)
    with zarr.config.set({"array.write_empty_chunks": True}):
        for name, array in ours.arrays():
            copy = theirs.create_array(
                name, shape=array.shape, chunks=array.chunks, dtype=array.dtype,
                compressors=array.compressors,
            )  # fmt: skip
            assert array.chunks[1] == 3
            copy[:] = streamed.dataset[name].values
            files = sorted(path.name for path in (tmp_path / "zarr" / name).glob("0.*"))
            assert len(files) == -(-40 // array.chunks[1])
            for file in files:
                written = (tmp_path / "draws.zarr" / name / file).read_bytes()
                assert written == (tmp_path / "zarr" / name / file).read_bytes(), (name, file)


def test_draws_are_read_when_they_are_used(posterior, tmp_path):
    pm.sample(posterior, SAMPLERS["mh"], draws=80, chains=2, stream=tmp_path, progress=False)
    draws = pm.open_draws(tmp_path)
    tree = draws.to_arviz()
    assert not any(draws.dataset[name]._in_memory for name in ("positions", "theta"))
    assert tree["posterior"]["theta"].sizes["draw"] == 40
    score = pm.score("gait-monocular", pm.sample("gait-monocular", draws=40, stream=tmp_path / "a"))
    assert score.verdict is not None


def test_ctrl_c_stores_the_finished_draws(posterior, tmp_path, monkeypatch):
    sampler, calls = SAMPLERS["ancestral3d"], []
    original = type(sampler)._batches

    def interrupted(self, *arguments):
        source = original(self, *arguments)
        draw = source.draw

        def stop(streams, tick):
            calls.append(1)
            if len(calls) == 4:
                raise KeyboardInterrupt
            return draw(streams, tick)

        source.draw = stop
        return source

    monkeypatch.setattr(type(sampler), "_batches", interrupted)
    with pytest.raises(Interrupted) as caught:
        streams.stream_draws(sampler, posterior, tmp_path, **RUN)
    finished = caught.value.draws.positions
    assert 0 < finished.sizes["draw"] < 40
    resumed = streams.stream_draws(sampler, posterior, tmp_path, **RUN).positions
    np.testing.assert_array_equal(resumed[:, : finished.sizes["draw"]], finished)
    np.testing.assert_allclose(resumed, sampler.sample(posterior, **RUN).positions, atol=1e-9)


@pytest.mark.parametrize("draws", [5, 40])
@pytest.mark.parametrize(
    ("sampler", "changes", "message"),
    [
        (SAMPLERS["mh"], {"seed": 4}, "seed must be 3, as in the run to be continued, got 4"),
        (SAMPLERS["mh"], {"chains": 3}, r"stream must have draws of \(3, 6, 17\) chains, frames"),
        (SAMPLERS["smc"], {}, "sampler must be mh, as in the run to be continued, got smc"),
        (pm.samplers.MetropolisHastings(warmup=21, thin=1), {}, "settings must be"),
    ],
)
def test_another_run_is_refused(sampler, changes, message, draws, posterior, tmp_path):
    """Also where the folder already has as many draws."""
    streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **{**RUN, "draws": 5})
    with pytest.raises(ValueError, match=message):
        streams.stream_draws(sampler, posterior, tmp_path, **RUN | {"draws": draws} | changes)


@pytest.mark.parametrize("draws", [5, 40])
@pytest.mark.parametrize("name", ["mh", "ancestral3d"])
def test_another_posterior_is_refused(name, draws, posterior, tmp_path):
    streams.stream_draws(SAMPLERS[name], posterior, tmp_path, **{**RUN, "draws": 5})
    other = pm.problem("gait-occluded", frames=6).posterior
    with pytest.raises(ValueError, match="stream must have draws of the same posterior"):
        streams.stream_draws(SAMPLERS[name], other, tmp_path, **{**RUN, "draws": draws})


def test_lost_draws_are_not_replaced(posterior, tmp_path):
    streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **{**RUN, "draws": 5})
    shutil.rmtree(tmp_path / "draws.zarr")
    with pytest.raises(ValueError, match=r"draws.zarr is damaged"):
        streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **RUN)


def test_runs_that_cannot_be_continued_stream_one_block(posterior, tmp_path):
    def function(log_density, dim, rng, draws):
        return rng.standard_normal((draws, dim))

    with pytest.raises(ValueError, match="draws must be at most 16 per chain for function, whose"):
        pm.sample(posterior, function, draws=80, chains=2, stream=tmp_path / "a", progress=False)
    draws = pm.sample(posterior, function, draws=30, chains=2, stream=tmp_path / "b")
    assert np.isfinite(draws.positions.values).all()


def test_folders_in_use_and_other_folders_are_refused(posterior, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="stream must be a new folder or one of a run"):
        streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **RUN)
    with pytest.raises(FileNotFoundError, match="path must be a folder with complete draws"):
        pm.open_draws(tmp_path)
    (tmp_path / "notes.txt").unlink()
    with locked_folder("stream", tmp_path):
        for unfinished in (".lock", "last.nc.partial"):
            (tmp_path / unfinished).touch()
            with pytest.raises(ValueError, match="to which another process writes"):
                streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **RUN)
    # A lock alone does not make other files a run.
    with pytest.raises(ValueError, match="stream must be a new folder or one of a run"):
        streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **RUN)


def test_runs_that_were_copied_without_their_lock_are_continued(posterior, tmp_path):
    streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **{**RUN, "draws": 5})
    (tmp_path / ".lock").unlink()
    draws = streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **RUN)
    assert draws.positions.sizes["draw"] == RUN["draws"]


def test_damaged_draws_are_not_believed(posterior, tmp_path):
    streams.stream_draws(SAMPLERS["mh"], posterior, tmp_path, **RUN)
    chunks = [path for path in (tmp_path / "draws.zarr" / "theta").iterdir() if path.name[0] != "."]
    for path in chunks:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 4
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"theta is damaged: .* checksum do not match"):
        pm.open_draws(tmp_path).dataset["theta"].load()
    os.truncate(tmp_path / "last.nc", 200)
    with pytest.raises(ValueError, match="path must be a netCDF file of draws"):
        pm.open_draws(tmp_path)

"""Draws: saving, loading and conversion without loss."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar

import arviz_base
import numpy as np
import pytest
import xarray as xr

from probmotion import MotionDraws, MotionPosterior, Skeleton
from probmotion.posteriors.draws import library_versions

CHAINS, DRAWS, FRAMES, DIM = 2, 5, 3, 4
CHAIN = Skeleton(["Hüfte・腰", "knee"], [-1, 0], [0.05, 0.04])
SEED = 2**100  # beyond the 32 bits of netCDF


class Flat:
    skeleton, frames, fps, dim = CHAIN, FRAMES, 25.0, DIM

    def motion(self, theta):
        return np.zeros((*theta.shape[:-1], FRAMES, 2, 3))


@dataclass(frozen=True)
class Walker:
    name: ClassVar[str] = "walker"
    step: float = 0.5
    inner: Any = None


def some_draws(**changes):
    rng = np.random.default_rng(0)
    given = {
        "seed": SEED,
        "seconds": 1.5,
        "theta": rng.standard_normal((CHAINS, DRAWS, DIM)),
        "log_density": rng.standard_normal((CHAINS, DRAWS)),
        "statistics": {
            "acceptance_rate": rng.random((CHAINS, DRAWS)),
            "diverging": rng.random((CHAINS, DRAWS)) < 0.5,
            "step_size": rng.random(CHAINS),
        },
        "counts": {"density": 2**40, "gradient": 0},
        "state": {"theta": rng.standard_normal((CHAINS, DIM)), "scale": np.float64(0.25)},
    } | changes
    positions = given.pop("positions", rng.standard_normal((CHAINS, DRAWS, FRAMES, 2, 3)))
    posterior = MotionPosterior(Flat())
    return MotionDraws.of(posterior, Walker(inner=Walker(step=2.0)), positions, **given)


def test_metadata():
    draws = some_draws(independent=True)
    assert (draws.skeleton, draws.seconds, draws.independent) == (CHAIN, 1.5, True)
    assert draws.counts == {"density": 2**40, "gradient": 0}
    assert draws.dataset.attrs["seed"] == SEED
    assert '"step": 2.0' in draws.dataset.attrs["settings"]
    np.testing.assert_array_equal(draws.state["scale"], 0.25)


def test_motions_are_the_draws_in_order():
    draws = some_draws()
    motion = draws.motion(draw=3, chain=1)
    assert (motion.fps, motion.skeleton, motion.name) == (25.0, CHAIN, "walker-1-3")
    np.testing.assert_array_equal(motion.positions, draws.positions.values[1, 3])
    motions = np.stack([motion.positions for motion in draws.motions()])
    np.testing.assert_array_equal(motions, draws.flat())
    np.testing.assert_array_equal(draws.playback(chain=1).positions, motions[5:].reshape(15, 2, 3))


@pytest.mark.parametrize("full", [True, False])
def test_saved_draws_load_unchanged(tmp_path, full):
    left_out = dict.fromkeys(("theta", "log_density", "statistics", "counts", "state"))
    draws = some_draws(**({} if full else left_out))
    draws.save(tmp_path / "draws.nc")
    loaded = MotionDraws.load(tmp_path / "draws.nc")
    assert set(loaded.dataset.variables) == set(draws.dataset.variables)
    for name, values in draws.dataset.variables.items():
        np.testing.assert_array_equal(loaded.dataset[name].values, values.values)
        assert loaded.dataset[name].dims == values.dims
    for name in ("skeleton", "fps", "seconds", "counts", "independent"):
        assert getattr(loaded, name) == getattr(draws, name)
    assert loaded.skeleton.radii == CHAIN.radii
    for name in ("seed", "settings", "versions", "sampler"):
        assert loaded.dataset.attrs[name] == draws.dataset.attrs[name]
    loaded.save(tmp_path / "again.nc")
    np.testing.assert_array_equal(MotionDraws.load(tmp_path / "again.nc").flat(), draws.flat())


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_failed_saves_leave_the_folder_unchanged(tmp_path, monkeypatch, error):
    draws, path = some_draws(), tmp_path / "draws.nc"
    draws.save(path)
    before = path.read_bytes()

    def broken(self, unfinished, **_):
        Path(unfinished).write_bytes(b"half")
        raise error

    monkeypatch.setattr(xr.Dataset, "to_netcdf", broken)
    with pytest.raises(type(error)):
        draws.save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["draws.nc"]


def test_invalid_files_are_rejected(tmp_path):
    path = tmp_path / "other.nc"
    some_draws().save(path)
    content = path.read_bytes()
    parts = [content[:end] for end in (10, 100, len(content) // 2, len(content) - 1000)]
    for damaged in (*parts, b"", b"not a file of numbers", b"\x89HDF\r\n\x1a\n" + bytes(64)):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"path must be a netCDF file of draws, got .*other"):
            MotionDraws.load(path)
    xr.Dataset({"x": ("n", [1.0])}).to_netcdf(path, engine="scipy")
    with pytest.raises(ValueError, match="must have format version 1, got None"):
        MotionDraws.load(path)
    with pytest.raises(FileNotFoundError):
        MotionDraws.load(tmp_path / "none.nc")
    with pytest.raises(ValueError, match=r"path must end in \.nc"):
        some_draws().save(tmp_path / "draws.zarr")


def test_conversion_to_arviz():
    draws = some_draws()
    tree = draws.to_arviz()
    assert set(tree["posterior"].data_vars) == {"positions", "theta"}
    statistics = {"lp", "acceptance_rate", "diverging", "step_size"}
    assert set(tree["sample_stats"].data_vars) == statistics
    np.testing.assert_array_equal(tree["sample_stats"]["lp"], draws.dataset["log_density"])
    theta = arviz_base.extract(tree, var_names=["theta"], combined=True)
    expected = draws.dataset["theta"].values.reshape(-1, DIM)
    np.testing.assert_array_equal(theta.transpose("sample", ...).values, expected)


BROKEN = np.zeros((CHAINS, DRAWS, FRAMES, 2, 3))
BROKEN[1, 2, 0, 0, 0] = np.nan


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": BROKEN[..., :2]}, r"positions must have shape \(chain, draw, 3, 2, 3\)"),
        ({"positions": BROKEN}, "positions must be finite, got 1 values"),
        ({"theta": np.zeros((CHAINS, DRAWS, 3))}, r"theta must have shape \(2, 5, 4\)"),
        ({"log_density": np.zeros((DRAWS, CHAINS))}, r"log_density must have shape \(2, 5\)"),
        ({"statistics": {"step": np.zeros((3, DRAWS))}}, r"step must have shape \(2, 5\)"),
    ],
)
def test_invalid_arguments(changes, message):
    with pytest.raises(ValueError, match=message):
        some_draws(**changes)


def test_versions_are_those_of_installed_packages(monkeypatch):
    def without_torch(package):
        if package == "torch":
            raise PackageNotFoundError(package)
        return version(package)

    monkeypatch.setattr("probmotion.posteriors.draws.version", without_torch)
    every = library_versions.__wrapped__()
    assert library_versions().keys() - every.keys() == {"torch"}
    assert every["numba"] == version("numba")

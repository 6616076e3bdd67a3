"""What a sampler returns: saved, loaded and converted without loss."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import xarray as xr

from probmotion import MotionDraws, MotionPosterior, Skeleton

CHAINS, DRAWS, FRAMES, DIM = 2, 5, 3, 4
CHAIN = Skeleton(["hip", "knee"], [-1, 0])


class Flat:
    skeleton, frames, fps, dim = CHAIN, FRAMES, 25.0, DIM

    def motion(self, theta: Any) -> Any:
        return np.zeros((*theta.shape[:-1], FRAMES, 2, 3))


@dataclass(frozen=True)
class Walker:
    """A sampler with settings of every kind."""

    name: ClassVar[str] = "walker"
    step: float = 0.5
    widths: tuple[int, ...] = (1, 2)
    inner: Any = None


def some_draws(**changes: Any) -> MotionDraws:
    rng = np.random.default_rng(0)
    given: dict[str, Any] = {
        "seed": 7,
        "seconds": 1.5,
        "theta": rng.standard_normal((CHAINS, DRAWS, DIM)),
        "log_density": rng.standard_normal((CHAINS, DRAWS)),
        "statistics": {
            "acceptance": rng.random((CHAINS, DRAWS)),
            "divergent": rng.random((CHAINS, DRAWS)) < 0.5,
            "step_size": rng.random(CHAINS),
        },
        "counts": {"density": 2**40, "gradient": 0},
        "state": {"theta": rng.standard_normal((CHAINS, DIM)), "scale": np.float64(0.25)},
    } | changes
    positions = given.pop("positions", rng.standard_normal((CHAINS, DRAWS, FRAMES, 2, 3)))
    posterior = MotionPosterior(Flat())
    return MotionDraws.of(posterior, Walker(inner=Walker(step=2.0)), positions, **given)


def test_draws_know_what_they_are() -> None:
    draws = some_draws()
    assert draws.positions.dims == ("chain", "draw", "frame", "joint", "axis")
    assert list(draws.positions["joint"].values) == ["hip", "knee"]
    assert (draws.skeleton, draws.fps, draws.seconds) == (CHAIN, 25.0, 1.5)
    assert draws.counts == {"density": 2**40, "gradient": 0}
    assert draws.dataset.attrs["seed"] == 7
    assert not draws.independent
    assert some_draws(independent=True).independent
    assert '"step": 2.0' in draws.dataset.attrs["settings"]
    assert '"numpy"' in draws.dataset.attrs["versions"]
    np.testing.assert_array_equal(draws.state["scale"], 0.25)


def test_motions_are_the_draws_in_order() -> None:
    draws = some_draws()
    motion = draws.motion(draw=3, chain=1)
    np.testing.assert_array_equal(motion.positions, draws.positions.values[1, 3])
    assert (motion.fps, motion.skeleton, motion.name) == (25.0, CHAIN, "walker-1-3")
    motions = list(draws.motions())
    assert len(motions) == CHAINS * DRAWS
    for motion, positions in zip(motions, draws.flat(), strict=True):
        np.testing.assert_array_equal(motion.positions, positions)


@pytest.mark.parametrize("full", [True, False])
def test_what_is_saved_is_what_is_loaded(tmp_path: Path, full: bool) -> None:
    left_out = dict.fromkeys(("theta", "log_density", "statistics", "counts", "state"))
    draws = some_draws(**({} if full else left_out))
    draws.save(tmp_path / "draws.nc")
    loaded = MotionDraws.load(tmp_path / "draws.nc")
    for name, values in draws.dataset.variables.items():
        np.testing.assert_array_equal(loaded.dataset[name].values, values.values)
        assert loaded.dataset[name].dims == values.dims
    assert set(loaded.dataset.variables) == set(draws.dataset.variables)
    assert loaded.skeleton == draws.skeleton
    assert (loaded.fps, loaded.seconds, loaded.counts) == (draws.fps, draws.seconds, draws.counts)
    assert loaded.independent == draws.independent
    assert loaded.state.keys() == draws.state.keys()
    for name in ("seed", "settings", "versions", "sampler"):
        assert loaded.dataset.attrs[name] == draws.dataset.attrs[name]
    # And once more: a file that was loaded saves again.
    loaded.save(tmp_path / "again.nc")
    np.testing.assert_array_equal(
        MotionDraws.load(tmp_path / "again.nc").positions.values, draws.positions.values
    )


def test_large_seeds_survive(tmp_path: Path) -> None:
    """netCDF's integers have 32 bits, Python's do not."""
    for seed in (0, 2**31, 2**63 - 1, 2**100):
        some_draws(seed=seed).save(tmp_path / "draws.nc")
        assert MotionDraws.load(tmp_path / "draws.nc").dataset.attrs["seed"] == seed


def test_skeletons_of_one_joint_and_of_other_alphabets_survive(tmp_path: Path) -> None:
    class Ball(Flat):
        skeleton = Skeleton(["Hüfte・腰"], [-1])

    positions = np.zeros((1, 1, FRAMES, 1, 3))
    posterior = MotionPosterior(Ball())
    draws = MotionDraws.of(posterior, Walker(), positions, seed=0, seconds=0.0)
    draws.save(tmp_path / "ball.nc")
    assert MotionDraws.load(tmp_path / "ball.nc").skeleton == Ball.skeleton


def test_a_failed_save_leaves_nothing_and_destroys_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draws = some_draws()
    path = tmp_path / "draws.nc"
    draws.save(path)
    before = path.read_bytes()

    def broken(self: xr.Dataset, unfinished: Path, **_: Any) -> None:
        Path(unfinished).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", broken)
    with pytest.raises(
        OSError, match=r"cannot write .*draws\.nc: No space left on device; expected"
    ):
        draws.save(path)
    assert path.read_bytes() == before
    with pytest.raises(OSError, match="No space left"):
        draws.save(tmp_path / "new.nc")
    assert [entry.name for entry in tmp_path.iterdir()] == ["draws.nc"]


def test_an_interrupted_save_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: xr.Dataset, unfinished: Path, **_: Any) -> None:
        Path(unfinished).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(xr.Dataset, "to_netcdf", interrupted)
    with pytest.raises(KeyboardInterrupt):
        some_draws().save(tmp_path / "draws.nc")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        OSError, match=r"cannot write .*missing.draws\.nc: .*expected a folder that"
    ):
        some_draws().save(tmp_path / "missing" / "draws.nc")
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError, match=r"cannot write .*draws\.nc: Not a directory; expected a fol"):
        some_draws().save(tmp_path / "file" / "draws.nc")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to read-only folders")
def test_a_read_only_folder_is_named(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(
        OSError, match=r"cannot write .*draws\.nc: Permission denied; expected a fol"
    ):
        some_draws().save(closed / "draws.nc")


def test_other_files_are_refused_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "other.nc"
    for content in (b"", b"not a file of numbers", b"CDF\x01", b"\x89HDF\r\n\x1a\n" + bytes(64)):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"path is '.*other\.nc', which is no netCDF file"):
            MotionDraws.load(path)
    some_draws().save(path)
    whole = path.read_bytes()
    for part in (10, 100, len(whole) // 2, len(whole) - 1000):
        path.write_bytes(whole[:part])
        with pytest.raises(ValueError, match=r"path is '.*other\.nc'"):
            MotionDraws.load(path)
    xr.Dataset({"x": ("n", [1.0])}).to_netcdf(path, engine="scipy")
    with pytest.raises(ValueError, match=r"with format version None, expected 1"):
        MotionDraws.load(path)
    with pytest.raises(FileNotFoundError):
        MotionDraws.load(tmp_path / "none.nc")


def test_arviz_reads_them() -> None:
    draws = some_draws()
    tree = draws.to_arviz()
    assert set(tree["posterior"].data_vars) == {"positions", "theta"}
    statistics = {"lp", "acceptance", "divergent", "step_size"}
    assert set(tree["sample_stats"].data_vars) == statistics
    np.testing.assert_array_equal(tree["sample_stats"]["lp"], draws.dataset["log_density"])
    arviz_base = pytest.importorskip("arviz_base")
    theta = arviz_base.extract(tree, var_names=["theta"], combined=True)
    row_by_row = draws.dataset["theta"].values.reshape(-1, DIM)
    np.testing.assert_array_equal(theta.transpose("sample", ...).values, row_by_row)
    inside = arviz_base.extract(tree, group="sample_stats", combined=False)
    np.testing.assert_array_equal(inside["acceptance"], draws.dataset["acceptance"])


def test_wrong_shapes_and_values_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"positions has shape .*expected \(chain, draw, 3, 2, 3\)"
    ):
        some_draws(positions=np.zeros((CHAINS, DRAWS, FRAMES, 3, 3)))
    broken = np.zeros((CHAINS, DRAWS, FRAMES, 2, 3))
    broken[1, 2, 0, 0, 0] = np.nan
    with pytest.raises(
        ValueError, match="positions must be finite, got 1 values that are NaN or infinite"
    ):
        some_draws(positions=broken)
    with pytest.raises(ValueError, match=r"theta must have shape \(2, 5, 4\), got \(2, 5, 3\)"):
        some_draws(theta=np.zeros((CHAINS, DRAWS, 3)))
    with pytest.raises(ValueError, match=r"log_density must have shape \(2, 5\), got \(5, 2\)"):
        some_draws(log_density=np.zeros((DRAWS, CHAINS)))
    with pytest.raises(ValueError, match=r"acceptance must have shape \(2, 5\), got \(3, 5\)"):
        some_draws(statistics={"acceptance": np.zeros((3, DRAWS))})


def test_only_netcdf_is_written_and_radii_are_kept(tmp_path):
    from dataclasses import replace

    from probmotion.problems import load_problem
    from probmotion.samplers import ExactSampler

    posterior = load_problem("gait").posterior
    prior = posterior.prior
    skeleton = Skeleton(
        prior.skeleton.joint_names, prior.skeleton.parents, [0.05] * prior.skeleton.n_joints
    )
    thick = MotionPosterior(replace(prior, skeleton=skeleton))
    draws = ExactSampler().sample(thick, draws=2, progress=False)
    with pytest.raises(ValueError, match=r"expected a name that ends in \.nc"):
        draws.save(tmp_path / "draws.zarr")
    draws.save(tmp_path / "draws.nc")
    assert MotionDraws.load(tmp_path / "draws.nc").motion(0).skeleton.radii == skeleton.radii

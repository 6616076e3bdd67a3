"""Damaged files and files of other versions are refused in a sentence, or made again."""

from __future__ import annotations

import json
import random
import zipfile
from dataclasses import asdict
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
import xarray as xr
from own_files import OWN, write_checkpoint
from safetensors import safe_open
from safetensors.torch import save_file
from toy_samplers import SMALL, PriorDraws, generation

import probmotion as pm
from probmotion.comparison import Comparison, compare
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import read_result
from probmotion.comparison.run.grid_tasks import PilotResult
from probmotion.files import read_arrays, read_json, write_json
from probmotion.io.errors import MotionFileError
from probmotion.models.mixture import SpectralMixtureMotion
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.posteriors import streams
from probmotion.posteriors.draws import MotionDraws

RUN = "runs/generation/prior-draws/0"


def write_grid(folder):
    compare(generation(), PriorDraws(), out=folder, **SMALL)
    for path in folder.iterdir():  # figures of people, not read again
        if path.name not in ("comparison.json", "runs"):
            path.unlink() if path.is_file() else None
    (folder / RUN / "draws.nc").unlink()


def read_grid(folder):
    result = read_result(folder / RUN)
    if result is None:  # and the run is made again
        raise ValueError("the run is damaged")
    return asdict(result), asdict(Plan.load(folder))


def write_pilot(folder):
    write_json(folder / "pilot.json", asdict(PilotResult("0" * 16, {"steps": 3})))


def read_pilot(folder):
    result = OWN["pilot"][1](folder)
    if result is None:  # and the pilot is made again
        raise ValueError("the pilot is damaged")
    return asdict(result)


def write_stream(folder):
    posterior = pm.problem("gait-monocular", frames=6).posterior
    sampler = pm.samplers.MetropolisHastings(warmup=20, thin=1)
    streams.stream_draws(sampler, posterior, folder, draws=40, chains=2, progress=False)


def read_stream(folder):
    draws = pm.open_draws(folder)
    kept = [draws.dataset[name].values for name in ("positions", "theta", "log_density")]
    return [*kept, draws.counts, draws.seconds]


def read_draws(folder):
    dataset = MotionDraws.load(folder / "draws.nc").dataset
    return {str(name): np.asarray(values) for name, values in dataset.variables.items()}


def read_checkpoint(folder):
    stored = load_checkpoint(folder / "model.safetensors", "toy")
    return {name: tensor.numpy() for name, tensor in stored.tensors.items()}, stored.settings


def read_reference(folder):
    stored = OWN["reference"][1](folder)
    known = {name: stored.certificate[name] for name in ("draws", "rhat", "seed", "fingerprint")}
    return stored.positions, known


KINDS = {
    "grid": (write_grid, read_grid),
    "pilot": (write_pilot, read_pilot),
    "stream": (write_stream, read_stream),
    "draws": (OWN["draws"][0], read_draws),
    "checkpoint": (write_checkpoint, read_checkpoint),
    "reference": (OWN["reference"][0], read_reference),
    "decomposition": (OWN["decomposition"][0], lambda f: OWN["decomposition"][1](f)._values),
    **{
        name: OWN[name]
        for name in ("annotations", "annotation prior", "pose depth", "joint limits", "category")
    },
    "stored problem": OWN["stored problem"],
}


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(streams, "_BLOCK_BYTES", 80_000)


FAULTS = [(name, fault) for name in KINDS for fault in ("flipped bit", "cut file", "missing file")]
# Without a file, nothing is stored yet.
for name in ("decomposition", "stored problem"):
    FAULTS.remove((name, "missing file"))


@pytest.mark.filterwarnings("ignore")  # of the libraries that read damaged files
@pytest.mark.parametrize(("name", "fault"), FAULTS)
def test_damaged_files_are_not_believed(name, fault, tmp_path, account, moments):
    write, read = KINDS[name]
    write(tmp_path)
    expected = fingerprint(read(tmp_path))
    rng = random.Random(crc32(f"{name} {fault}".encode()))
    files = [path for path in sorted(tmp_path.rglob("*")) if path.is_file() and path.stat().st_size]
    for _ in range(10 * moments):
        path = rng.choice(files)
        content = path.read_bytes()
        place = rng.randrange(len(content))
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.randrange(8)
        with account(fault, name):
            match fault:
                case "flipped bit":
                    path.write_bytes(damaged)
                case "cut file":
                    path.write_bytes(content[:place])
                case "missing file":
                    path.unlink()
            try:
                result = fingerprint(read(tmp_path))
            except (
                ValueError,
                OSError,
                RuntimeError,
            ):  # RuntimeError: by Zarr, when draws are read
                pass
            else:  # a byte that nobody reads
                assert result == expected, (path, place)
        path.write_bytes(content)


def raise_version(folder, name):
    """Raise the version number of a file."""
    match name:
        case "draws":
            with xr.open_dataset(folder / "draws.nc", engine="scipy") as opened:
                dataset = opened.load().assign_attrs(format_version=2)
            del dataset.attrs["checksum"]
            dataset.to_netcdf(folder / "draws.nc", engine="scipy")
            MotionDraws.load(folder / "draws.nc")
        case "checkpoint":
            path = folder / "model.safetensors"
            with safe_open(path, framework="pt") as file:
                header = json.loads(file.metadata()["probmotion"]) | {"format": 2}
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            save_file(tensors, path, metadata={"probmotion": json.dumps(header)})
            load_checkpoint(path, "toy")
        case "grid":
            write_json(
                folder / "comparison.json", read_json(folder / "comparison.json") | {"format": 4}
            )
            Comparison.load(folder)
        case "spectral prior":
            with np.load(folder / "prior.npz") as archive:
                arrays = dict(archive)
            arrays["header"] = np.array(
                json.dumps(json.loads(str(arrays["header"])) | {"format": 2})
            )
            np.savez(folder / "prior.npz", **arrays)
            SpectralMixtureMotion.load(folder / "prior.npz")


WRITERS = {
    "draws": OWN["draws"][0],
    "checkpoint": write_checkpoint,
    "grid": write_grid,
    "spectral prior": lambda folder: SpectralMixtureMotion.load().save(folder / "prior.npz"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_of_a_later_version_are_refused(name, tmp_path, account):
    WRITERS[name](tmp_path)
    with account("later version", name), pytest.raises(ValueError, match=r"version|format"):
        raise_version(tmp_path, name)


def test_files_without_a_checksum_are_read(tmp_path):
    """As written before there were checksums."""
    draws = OWN["draws"][0]
    draws(tmp_path)
    with xr.open_dataset(tmp_path / "draws.nc", engine="scipy") as opened:
        dataset = opened.load()
    del dataset.attrs["checksum"]
    dataset.to_netcdf(tmp_path / "old.nc", engine="scipy")
    MotionDraws.load(tmp_path / "old.nc")
    (tmp_path / "old.json").write_text('{"a": 1}')
    assert read_json(tmp_path / "old.json") == {"a": 1}
    write_json(Path(tmp_path, "new.json"), {"a": 1, 2: [0.1, None]})
    assert read_json(tmp_path / "new.json") == {"a": 1, "2": [0.1, None]}


def test_no_flipped_bit_hides_an_array(tmp_path):
    path = tmp_path / "clip.npz"
    motion = {"positions": np.zeros((2, 1, 3)), "joint_names": ["hip"], "parents": [-1], "fps": 30}
    np.savez(path, **motion, up_axis="z")
    content = path.read_bytes()
    start = content.index(b"PK\x01\x02")  # the directory at the end
    for bit in range(8 * start, 8 * len(content)):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            arrays = read_arrays(path)
        except ValueError:
            with pytest.raises(MotionFileError):
                pm.load(path)
        else:
            assert list(arrays) == [*motion, "up_axis"]


def test_archives_of_other_tools_are_read(tmp_path):
    path = tmp_path / "arrays.npz"
    np.savez(path, first=np.arange(3))
    with zipfile.ZipFile(path, "a") as archive:
        archive.mkdir("folder")
        archive.comment = b"made by another tool"
    path.write_bytes(path.read_bytes() + b"\n")
    assert list(read_arrays(path)) == ["first"]


@pytest.mark.parametrize(("name", "value"), [("n", 10**400), ("classifier", [0.5, 0.0])])
def test_impossible_statistics_are_not_believed(name, value, tmp_path):
    OWN["comparison"][0](tmp_path)
    path = tmp_path / "runs/filmed/good/0/run.json"
    assert read_result(path.parent) is not None
    stored = read_json(path)
    stored["statistics"][name] = value
    write_json(path, stored)
    assert read_result(path.parent) is None

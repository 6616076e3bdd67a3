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
from made_reports import WALK
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
from probmotion.models.images.category import Category
from probmotion.models.mixture import SpectralMixtureMotion
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.posteriors import streams
from probmotion.posteriors.draws import MotionDraws
from probmotion.samplers.mcmc import stored_chain
from probmotion.samplers.mcmc.stored_chain import StoredChain

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


def write_chain(folder):
    state = {"draws": np.ones((2, 3)), "random": np.array(["a", "b"])}
    StoredChain(folder / "chain.npz").save(lambda: state)


def read_motion(folder):
    motion = pm.load(folder / "walk.npz")
    return vars(motion) | {"skeleton": vars(motion.skeleton)}


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
    "chain": (write_chain, OWN["chain"][1]),
    "motion": (lambda folder: pm.save(WALK, folder / "walk.npz"), read_motion),
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
    monkeypatch.setattr(stored_chain, "_SECONDS", 0.0)


FAULTS = [(name, fault) for name in KINDS for fault in ("flipped bit", "cut file", "missing file")]
# Without a file, nothing is stored yet.
for name in ("chain", "decomposition", "stored problem"):
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
            except (ValueError, OSError):
                pass
            else:  # a byte that nobody reads
                assert result == expected, (path, place)
        path.write_bytes(content)


def edit_archive(name, change):
    """Return a function that changes the arrays of an archive."""

    def edit(folder, number):
        arrays = read_arrays(folder / name)
        change(arrays, number)
        np.savez(folder / name, **arrays)

    return edit


def set_format(content, number):
    """Set or, if it is None, remove the format."""
    if number is None:
        del content["format"]
    else:
        content["format"] = np.array(number)


def set_header(key):
    """Return a function that sets the format in the header of an archive."""

    def change(arrays, number):
        arrays[key] = np.array(json.dumps(json.loads(str(arrays[key])) | {"format": number}))

    return change


def edit_json(name):
    def edit(folder, number):
        content = read_json(folder / name)
        del content["format"]
        write_json(folder / name, content | ({} if number is None else {"format": number}))

    return edit


def edit_draws(name):
    def edit(folder, number):
        with xr.open_dataset(folder / name, engine="scipy") as opened:
            dataset = opened.load().assign_attrs(format_version=number)
        del dataset.attrs["checksum"]
        dataset.to_netcdf(folder / name, engine="scipy")

    return edit


def edit_zarr(folder, number):
    for path in (folder / "draws.zarr").rglob(".z[ag]r*"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"zarr_format": number}))


def edit_checkpoint(folder, number):
    path = folder / "model.safetensors"
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["probmotion"]) | {"format": number}
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    save_file(tensors, path, metadata={"probmotion": json.dumps(header)})


# The format of files without a number is 1.
UNNUMBERED = {
    "annotations": edit_archive("a.npz", set_format),
    "annotation prior": edit_archive("p.npz", set_format),
    "joint limits": edit_archive("l.npz", set_format),
    "chain": edit_archive("chain.npz", set_format),
    "stored problem": edit_archive("problem.npz", set_format),
    "decomposition": edit_json("decompose_error.json"),
    "reference": edit_json("toy/certificate.json"),
}
# Runs and pilots are read by the plan of their grid.
NUMBERED = UNNUMBERED | {
    "draws": edit_draws("draws.nc"),
    "stream": edit_draws("last.nc"),
    "arrays of a stream": edit_zarr,
    "checkpoint": edit_checkpoint,
    "grid": edit_json("comparison.json"),
    "pose depth": edit_archive("d.npz", set_header("header")),
    "category": edit_archive("c.npz", set_header("settings")),
    "spectral prior": edit_archive("prior.npz", set_header("header")),
}
VERSIONED = KINDS | {
    "grid": (write_grid, Comparison.load),
    "category": (
        lambda folder: Category.load("quadruped").save(folder / "c.npz"),
        lambda folder: Category.load(folder / "c.npz"),
    ),
    "arrays of a stream": KINDS["stream"],
    "spectral prior": (
        lambda folder: SpectralMixtureMotion.load().save(folder / "prior.npz"),
        lambda folder: SpectralMixtureMotion.load(folder / "prior.npz"),
    ),
}


@pytest.mark.parametrize("name", NUMBERED)
def test_files_of_a_later_version_are_refused(name, tmp_path, account):
    write, read = VERSIONED[name]
    write(tmp_path)
    NUMBERED[name](tmp_path, 99)
    with account("later version", name):
        with pytest.raises(ValueError) as caught:  # noqa: PT011 (its message is checked below)
            read(tmp_path)
        message = str(caught.value).replace(str(tmp_path), "")
        assert "version" in message or "format" in message


@pytest.mark.parametrize("name", UNNUMBERED)
def test_files_without_a_format_are_read(name, tmp_path, account):
    """As written before there were formats."""
    write, read = KINDS[name]
    write(tmp_path)
    expected = fingerprint(read(tmp_path))
    UNNUMBERED[name](tmp_path, None)
    with account("no version", name):
        assert fingerprint(read(tmp_path)) == expected


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


@pytest.mark.parametrize(
    ("name", "value"),
    [("n", 10**400), ("classifier", [0.5, 0.0]), ("spread", [[1.0, 1.0], [1.0, 1.0]])],
)
def test_impossible_statistics_are_not_believed(name, value, tmp_path):
    OWN["comparison"][0](tmp_path)
    path = tmp_path / "runs/filmed/good/0/run.json"
    assert read_result(path.parent) is not None
    stored = read_json(path)
    stored["statistics"][name] = value
    write_json(path, stored)
    assert read_result(path.parent) is None


@pytest.mark.parametrize("entry", ["problem", "sampler", "seed"])
def test_results_of_other_runs_are_not_believed(entry, tmp_path):
    OWN["comparison"][0](tmp_path)
    path = tmp_path / "runs/filmed/good/0/run.json"
    stored = read_json(path)
    write_json(path, stored | {entry: 7 if entry == "seed" else "other"})
    assert read_result(path.parent) is None

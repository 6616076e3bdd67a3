"""Mutated files of every kind are read, or refused in one sentence of this package.

``make fuzz`` sets the number of inputs in ``PROBMOTION_FUZZ``. An input is reproduced from the
kind and number in the error: ``failure_of(KINDS[kind], number)``.
"""

import os
import resource
import signal
import tempfile
import warnings
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from unittest import mock
from zlib import crc32

import motion_files as files
import numpy as np
import pytest
from mutations import mutated
from own_files import OWN

from probmotion.cli.main import _parse as parse, main
from probmotion.cli.settings_options import object_from_text
from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError
from probmotion.io.files import load, read_joints
from probmotion.io.keypoints.calibration import read_calibration
from probmotion.io.keypoints.files import read_keypoints
from probmotion.io.predictions import read_predictions
from probmotion.motion.motion import JointTrack, Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.problems import catalogue
from probmotion.samplers.diffusion.guidance import DPS

INPUTS = int(os.environ.get("PROBMOTION_FUZZ", "10000"))
ROOT = Path(__file__).resolve().parents[2]
SECONDS = 20  # per input


@dataclass(frozen=True)
class Kind:
    """Files by path, the function that reads their folder, and the share of all inputs."""

    files: dict[str, bytes]
    read: object
    share: float = 1.0
    refusal: type = ValueError

    @property
    def megabytes(self):
        """Memory for all inputs; the HDF5 library believes the sizes in damaged files."""
        return 3000 if "clip.h5" in self.files else 700


def motion_kind(read, ending, *contents, share=2.0):
    """Return a kind of motion file for each of several contents."""
    name = f"clip{ending}"
    return [
        Kind({name: content}, lambda folder: read(folder / name), share, MotionFileError)
        for content in contents
    ]


def read_names(folder):
    """Read a text as a problem and as a setting of a sampler."""
    text = (folder / "words.txt").read_bytes().decode("utf-8", "replace")
    name, scale = catalogue._resolve(text, {})
    assert name in catalogue.problem_names()
    return name, scale


def read_setting(folder):
    text = (folder / "words.txt").read_bytes().decode("utf-8", "replace")
    assert isinstance(object_from_text(text, [DPS]), DPS)


def status_of(words):
    """Run a command and return its status."""
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    assert status in (0, 2)
    return status


def read_words(folder):
    """Convert a motion."""
    text = (folder / "words.txt").read_bytes().decode("utf-8", "replace")
    words = [word.replace("IN", str(folder / "clip.bvh")) for word in text.split()[:12]]
    return status_of(["convert", *(word.replace("OUT", str(folder / "out.npz")) for word in words)])


def parse_words(folder):
    """Parse a command without running it."""
    text = (folder / "words.txt").read_bytes().decode("utf-8", "replace")

    def parsed(name, words):
        parse(name, words)
        return SimpleNamespace(run=lambda: None)

    with mock.patch("probmotion.cli.main._parse", parsed):
        return status_of(text.split())


def motion_kinds():
    tracks = partial(read_keypoints, fps=30)
    skeleton = {"clip.asf": files.ASF, "clip.amc": files.AMC}
    kinds = [
        *motion_kind(partial(read_bvh, end_sites=True), ".bvh", files.BVH),
        *motion_kind(load, ".npz", *files.ARCHIVES),
        *motion_kind(partial(read_joints, unit="m"), ".npz", files.ARCHIVES[0]),
        *motion_kind(partial(read_predictions, skeleton=LEG), ".npz", files.ARCHIVES[0]),
        *motion_kind(tracks, ".npz", files.ARCHIVES[1]),
        *motion_kind(tracks, ".json", *files.JSONS),
        *motion_kind(tracks, ".csv", files.TABLE, files.LANDMARK_TABLE),
        *motion_kind(tracks, ".h5", *files.HDF5, share=0.5),
        *motion_kind(read_joints, ".trc", files.TRC),
        *motion_kind(read_calibration, ".toml", files.CAMERAS),
        Kind(skeleton, lambda folder: load(folder / "clip.amc"), 2.0, MotionFileError),
    ]
    return {f"motion {place}": kind for place, kind in enumerate(kinds)}


LEG = Skeleton(["hip", "knee"], [-1, 0])
# Readers that take more than a millisecond get fewer inputs.
SHARES = {"report": 0.01, "comparison": 0.1, "draws": 0.4, "joint limits": 0.4, "summary": 0.3}
SHARES |= {"category": 0.1, "images": 0.4}
SHARES |= {"stored problem": 0.5, "checkpoint": 0.5, "stream": 0.1, "spectral prior": 0.5}
WORDS = {
    "problem": (b"gait-monocular(frames=20, noise=0.05)", read_names, 1.0),
    "setting": (b"DPS(step_size=0.5)", read_setting, 1.0),
    "command": (b"IN OUT --fps 30 --unit cm --up z --mirror", read_words, 0.02),
}
COMMANDS = (
    "lift k.json --out o --image-size 1920 1080 --fps 30 --person 0 --fov 60 --draws 5 --strict",
    "show clip.bvh --fps 30 --unit cm --image-size 1920 1080 --skeleton coco17 --figure f.png",
    "compare gait-monocular --samplers mh nuts --draws 4 --seeds 2 --out o --settings.mh.thin 3 "
    "--settings.mh.warmup 20 --settings.mas.guidance DPS(step_size=2) --evaluations 100 --quick",
    "denoise a.npz --out o --noise .02 --draws 3 --outliers --unit mm --up z",
    "reconstruct a.png --mask m.png --category quadruped --out o --fov 40 --draws 3 --seed 1",
    "train diffusion --out o --size tiny --steps 3 --learning-rate 1e-3 --clips a.npz b.npz",
    "train evaluator --out o --size small --frames 30 --batch 4 --device cpu --threshold .1",
    "train lifter --out o --tracks a.json --tracks-fps 30 --layout coco17 --validation a --test b",
    "train dvae --out o --clips a.npz --validation a --test b --steps 3",
    "train denoiser --out o --prior o --least .01 --hidden .2 --clips a.npz --data-seed 1",
    "train motion-vae --out o --tracks a.json --kl .1 --front nose --views 8 --centre sequence",
    "train images --out o --category quadruped --images 9 --rounds 2 --fov 40 --batch 4",
)
WORDS |= {
    " ".join(line.split()[: 1 + line.startswith("train")]): (
        line.encode(), parse_words, 0.002 if line.startswith("compare") else 0.02
    )
    for line in COMMANDS
}  # fmt: skip


@cache
def kinds():
    """Return all kinds by name."""
    result = motion_kinds()
    for name, (write, read) in OWN.items():
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            paths = [path for path in Path(folder).rglob("*") if path.is_file()]
            content = {str(path.relative_to(folder)): path.read_bytes() for path in paths}
        result[name] = Kind(content, read, SHARES.get(name, 1.0))
    for name, (words, read, share) in WORDS.items():
        result[name] = Kind({"words.txt": words, "clip.bvh": files.BVH}, read, share)
    return result


NAMES = [*motion_kinds(), *OWN, *WORDS]


def failure_of(name, number, folder):
    """Return whether one input was refused; raise whatever is no refusal."""
    kind = kinds()[name]
    rng = np.random.default_rng([crc32(name.encode()), number])
    names = [file for file in kind.files if not (name in WORDS and file == "clip.bvh")]
    chosen = names[rng.integers(len(names))]
    for file, content in kind.files.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(mutated(rng, file, content) if file == chosen else content)
    try:
        result = kind.read(folder)
    except kind.refusal as error:
        check_refusal(error, folder)
        return True
    check_result(result)
    return False


def check_refusal(error, folder):
    """Check that an error was raised by this package, with a sentence of readable length."""
    trace = error.__traceback__
    while trace.tb_next is not None:
        trace = trace.tb_next
    source = Path(trace.tb_frame.f_code.co_filename)
    assert source.is_relative_to(ROOT), f"{type(error).__name__} of {source}: {error}"
    # A virtual environment may be in the project's folder.
    foreign = {"tests", "site-packages"} & set(source.relative_to(ROOT).parts)
    assert not foreign, f"{type(error).__name__} of {source}: {error}"
    message = str(error).replace(str(folder), "")
    assert any(word in message for word in ("expected", "must", "damaged", "another")), message
    assert len(message) < 1200, message


def check_result(result):
    if isinstance(result, Motion):
        assert np.isfinite(result.positions).all()
    elif isinstance(result, JointTrack):
        assert not np.isinf(result.joints).any()
        assert result.seen.any()


def stop(*_):
    raise TimeoutError(f"an input took more than {SECONDS} seconds")


@pytest.fixture
def watched(name):
    """Stop inputs that hang, and check the memory of all."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    previous = signal.signal(signal.SIGALRM, stop)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < kinds()[name].megabytes


@pytest.mark.parametrize("name", NAMES)
def test_undamaged_files_are_read(name, tmp_path, watched, capsys):
    for file, content in kinds()[name].files.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes(content)
    result = kinds()[name].read(tmp_path)
    assert not (isinstance(result, int) and result == 2)  # the status of a failing command


@pytest.mark.parametrize("name", NAMES)
def test_mutated_files_are_read_or_refused(name, tmp_path, watched, capsys):
    total = sum(kind.share for kind in kinds().values())
    inputs = max(5, round(INPUTS * kinds()[name].share / total))
    foreign, refused = [], 0
    for number in range(inputs):
        signal.alarm(SECONDS)
        try:
            refused += failure_of(name, number, tmp_path)
        except Exception as error:
            foreign.append(f"{name}, {number}: {type(error).__name__}: {str(error)[:300]}")
        signal.alarm(0)
    assert not foreign, f"{len(foreign)} of {inputs}\n" + "\n".join(foreign[:10])
    print(f"{name}: {inputs} inputs, {refused} refused")

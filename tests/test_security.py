"""What is read cannot run code, unpack without limit or become markup."""

from __future__ import annotations

import ast
import io
import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from made_reports import MARKUP, WALK

from probmotion.comparison.results.plan import Plan
from probmotion.files import read_arrays, read_json
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.io.errors import MotionFileError
from probmotion.io.files import load, read_joints
from probmotion.io.keypoints.files import read_keypoints
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
from probmotion.plots.animation import animate_skeletons, animated_page
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers.mcmc.stored_chain import StoredChain

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [
    path
    for package in ("probmotion", "samplers", "models")
    for path in sorted((ROOT / package).rglob("*.py"))
]
# Worker processes receive their tasks and return errors by pickle, through pipes of this package.
MAY_PICKLE = {"probmotion/comparison/run/processes.py"}
UNSAFE_MODULES = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "tarfile", "yaml"}
UNSAFE_CALLS = {
    "eval", "exec", "torch.load", "read_pickle", "to_pickle", "read_hdf", "os.system",
    "extract", "extractall", "unpack_archive", "urlopen", "urlretrieve",
}  # fmt: skip


def unsafe_in(source: str) -> list[str]:
    """Return the imports and calls in a source that could run what a file contains."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [n.name for n in node.names if n.name.partition(".")[0] in UNSAFE_MODULES]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found += [node.module] * (node.module.partition(".")[0] in UNSAFE_MODULES)
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in UNSAFE_CALLS or called.rpartition(".")[2] in UNSAFE_CALLS - {"eval"}:
                found.append(called)
            for keyword in node.keywords:
                text = f"{keyword.arg}={ast.unparse(keyword.value)}"
                found += [text] * (text in ("allow_pickle=True", "shell=True"))
    return found


def test_unsafe_code_is_found():
    for source in ("import pickle", "from joblib import load", "np.load(p, allow_pickle=True)",
                   "torch.load(p)", "archive.extractall()", "eval(text)"):  # fmt: skip
        assert unsafe_in(source), source
    assert not unsafe_in("network.eval(); np.load(path); import json")


def test_no_file_of_the_package_can_run_what_it_reads():
    for path in SOURCES:
        name = path.relative_to(ROOT).as_posix()
        if name not in MAY_PICKLE:
            assert unsafe_in(path.read_text("utf-8")) == [], name


class Opened:
    """Object whose unpickling writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


READERS = {
    "motion": load,
    "joints": read_joints,
    "keypoints": read_keypoints,
    "annotations": Annotations.load,
    "annotation prior": AnnotationPrior.load,
    "spectral mixture": SpectralMixtureMotion.load,
    "joint limits": JointLimits.load,
    "chain": lambda path: StoredChain(path).load(),
}
KEYS = (
    *("positions", "keypoints", "confidence", "fps", "joint_names", "parents", "header", "rings"),
    *("weights", "means", "noise", "allowed", "provenance", "visible", "neighbours"),
)


@pytest.mark.parametrize("kind", READERS)
def test_pickles_in_archives_are_not_opened(kind, tmp_path):
    path = tmp_path / "a.npz"
    array = np.array([Opened(tmp_path / "opened")], dtype=object)
    np.savez(path, **dict.fromkeys(KEYS, array))
    with np.load(path) as archive, pytest.raises(ValueError, match="Object arrays"):
        archive["fps"]
    with pytest.raises(ValueError, match=r"a\.npz"):
        READERS[kind](path)
    assert not (tmp_path / "opened").exists()


def bomb(path, megabytes=1000):
    """Write an archive of zeros that unpacks to a thousand times its size."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": (megabytes * 2**17,)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for key in KEYS[:2]:
            with archive.open(f"{key}.npy", "w") as member:
                member.write(head.getvalue())
                for _ in range(megabytes):
                    member.write(bytes(2**20))


def test_archives_do_not_unpack_without_limit(tmp_path):
    path = tmp_path / "a.npz"
    bomb(path, megabytes=100)
    assert path.stat().st_size < 2**20
    for read in READERS.values():
        with pytest.raises(ValueError, match=r"of at most 67108864 bytes, got 2\d{8}|written"):
            read(path)
    # Real motion compresses less, whatever its size.
    np.savez_compressed(path, noise=np.random.default_rng(0).normal(size=9_000_000))
    assert read_arrays(path)["noise"].nbytes > 2**26


def test_deep_and_foreign_json_is_refused(tmp_path):
    path = tmp_path / "a.json"
    for content in (b"[" * 100_000, b"\xff", b"{", b"9" * 5000):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"."):
            read_json(path)


def test_characters_that_do_not_exist_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    for code in (0x110000, 0xD800):
        names = np.array(["hip", "knee"])
        names.view(np.uint32)[0] = code
        np.savez(path, positions=np.ones((2, 2, 3)), joint_names=names, parents=[-1, 0], fps=30)
        with pytest.raises(MotionFileError, match="expected Unicode in joint_names"):
            load(path)


def test_every_page_loads_nothing_from_the_network():
    """All pages are written by one function, which states the policy."""
    pages = [path for path in SOURCES if "<!DOCTYPE html>" in path.read_text("utf-8")]
    assert [path.stem for path in pages] == ["animation"]
    assert "default-src 'none'" in animated_page("page", "")


def test_names_in_animations_are_text(tmp_path):
    path = tmp_path / "page.html"
    shown = animate_skeletons(
        {MARKUP: WALK.positions[None]}, WALK.skeleton, path, fps=30, title=MARKUP
    )
    page = path.read_text("utf-8")
    assert shown.html == page
    assert "<b onclick" not in page
    assert page.count("<script") == 2
    assert MARKUP not in shown._repr_html_()


@pytest.mark.parametrize("name", [MARKUP, r"$\frac{$", "$x$", "--><script>alert(1)</script>"])
def test_names_in_figures_are_text(name, tmp_path):
    path = tmp_path / "figure.svg"
    motions = WALK.positions[None]
    draw_skeletons({name: motions}, WALK.skeleton, path, title=name)
    tags = {element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()}
    assert not tags & {"script", "b", "a", "image", "foreignObject"}
    draw_skeletons({name: motions}, WALK.skeleton, tmp_path / "figure.png", title=name)


def test_names_in_plans_cannot_leave_their_folder(tmp_path):
    stored = {
        "format": 3, "problems": {"gait": ""}, "samplers": {"mh": {}}, "draws": 1, "chains": 1,
        "seeds": 1, "untuned": [], "references": [],
        "fingerprints": {"problem": {"gait": "a"}, "sampler": {"mh": "b"}},
    }  # fmt: skip
    path = tmp_path / "comparison.json"
    path.write_text(json.dumps(stored))
    assert list(Plan.load(tmp_path).problems) == ["gait"]
    for name in ("../gait", "/gait", "..", "a\\b", "a\0b", MARKUP):
        path.write_text(json.dumps(stored).replace('"gait"', json.dumps(name)))
        with pytest.raises(ValueError, match="names of problems must consist of letters"):
            Plan.load(tmp_path)

"""Notebooks run from top to bottom, and their results support their text."""

from __future__ import annotations

import base64
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probmotion import Comparison
from probmotion.comparison import advise

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


def run(name: str, folder: Path, figures: int, monkeypatch) -> str:
    """Execute a notebook in ``folder``, check its number of figures and return its output."""
    import jupytext
    from nbclient import NotebookClient

    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")
    # Use a kernel of the running interpreter, regardless of those installed.
    monkeypatch.setenv("JUPYTER_PATH", str(Path(sys.prefix) / "share" / "jupyter"))
    monkeypatch.setenv("IPYTHONDIR", str(folder / "ipython"))
    notebook = jupytext.read(NOTEBOOKS / name)
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == figures
    return "".join(
        output.get("text", output.get("data", {}).get("text/plain", "")) for output in outputs
    )


def animated_motions(report: Path) -> dict[str, np.ndarray]:
    """Return the animated motions of a self-contained report by label, (n, L, J, 3), metres."""
    text = report.read_text(encoding="utf-8")
    assert not re.search(r"https?:|src=|href=|@import", text)
    (given,) = re.findall(r'json">(.*?)</script>', text)
    data = json.loads(given)
    shape = (data["frames"], data["joints"], 3)
    rows = [[_decoded(motion).reshape(shape) for motion in row] for row in data["rows"]]
    labels = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    return {label: np.array(row) for label, row in zip(labels, rows, strict=True)}


def _decoded(motion: dict[str, Any]) -> np.ndarray:
    """Return the coordinates of an encoded motion, metres."""
    return motion["unit"] / 1000 * np.frombuffer(base64.b64decode(motion["numbers"]), "<i2")


# Libraries of Jupyter emit warnings.
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_one_posterior_many_samplers(tmp_path, monkeypatch):
    printed = run("01_one_posterior_many_samplers.py", tmp_path, 5, monkeypatch)
    assert "120 clips" in printed
    assert len(list((tmp_path / "walks").glob("*.bvh"))) == 120
    assert (tmp_path / "take3.bvh").exists()

    table = Comparison.load(tmp_path / "comparison").table()
    assert "swd ratio" in printed
    wide = table.pivot_table(index="sampler", columns="metric", values="value")
    assert set(wide.index) == {"exact", "ancestral3d", "mas", "mvpc", "split-gibbs", "mh"}
    assert 0.9 < wide.loc["ancestral3d", "off_manifold_ratio"] < 1.1
    assert wide.loc["ancestral3d", "mode_proportions_tv"] > 0.3
    assert 0.2 < wide.loc["split-gibbs", "mode_proportions_tv"] < 0.4
    assert wide.loc["mas", "variance_ratio"] > 1.5
    assert wide.loc["mvpc", "swd_ratio"] < wide.loc["mas", "swd_ratio"]
    evaluations = wide["denoiser_evaluations"]
    assert evaluations["mvpc"] == pytest.approx(evaluations["mas"], rel=0.1)
    assert wide.loc["mh", "swd_ratio"] < 1.5
    assert wide.loc["mh", "rhat"] > 1.05


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_pose_pairs(tmp_path, monkeypatch):
    from probmotion.io.files import load

    printed = run("02_pose_pairs.py", tmp_path, 5, monkeypatch)
    assert "90 of 90 frames show the dance" in printed
    assert "108 dimensions" in printed
    assert "200 annotations" in printed
    walk = load(tmp_path / "walk.bvh")
    assert walk.frames == 150
    assert len(walk.skeleton.roots) == 2
    accepted = float(printed.split("accepted: ")[1].split()[0])
    assert 0.15 < accepted < 0.35
    drawn, seed = re.search(r"coverage: ([\d.]+) m, by the seed alone ([\d.]+) m", printed).groups()
    assert float(drawn) < float(seed)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_motion_from_2d(tmp_path, monkeypatch):
    printed = run("03_motion_from_2d.py", tmp_path, 5, monkeypatch)
    assert "centre     640 → 640" in printed
    assert "train: 511 tracks of 32 clips" in printed
    assert (tmp_path / "walks.html").exists()
    losses = (tmp_path / "diffusion" / "losses.csv").read_text().splitlines()
    assert len(losses) == 7

    def numbers(words: str) -> list[float]:
        """Return the numbers after ``words`` in the same line."""
        line = printed.split(words, 1)[1].splitlines()[0]
        return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", line)]

    # The columns are FID, diversity, precision and recall.
    real, flat, mas = (numbers(row) for row in ("\nreal ", "\n2D model ", "\nmas "))
    assert real[0] < mas[0] < 1.2 * flat[0]
    assert mas[2] > 0.9 * flat[2]
    assert numbers("\nmas, no 3D noise ")[3] > 0.5
    # The columns are the distances to and from real motion, and the mirrored fraction.
    assert numbers("\nmas: ")[0] < 1.3 * numbers("\nreal: ")[0]
    assert numbers("\nmas: ")[2] < 0.1
    for kind in ("detected joints: ", "lost joints: "):
        detected, cleaned = numbers(kind)
        assert cleaned < 0.6 * detected
    # As the text says, some draws are stuck in a local optimum; the others match the observations.
    errors = np.array(numbers("error against observations, mm: "))
    stuck = errors > 80
    assert stuck.sum() <= 3
    truth_errors = np.array(numbers("error against truth, mm: "))
    assert truth_errors[~stuck].max() < 0.5 * numbers("without observations: ")[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_denoising(tmp_path, monkeypatch):
    monkeypatch.delenv("PROBMOTION_DATA", raising=False)
    printed = run("04_denoising.py", tmp_path, 1, monkeypatch)
    assert "walk-0: 75 frames at 30 fps, 14 joints" in printed
    numbers = r"\s+([\d.]+)" * 4
    rows = {
        name: [float(number) for number in re.search(re.escape(name) + numbers, printed).groups()]
        for name in (
            "Savitzky-Golay filter",
            "Kalman smoother",
            "Motion-DVAE, regression",
            "Motion-DVAE, optimization",
        )
    }
    for name in ("Savitzky-Golay filter", "Kalman smoother"):
        assert rows["Motion-DVAE, optimization"][2] < rows[name][2]  # occluded joints
    assert rows["Motion-DVAE, optimization"][0] < rows["Motion-DVAE, regression"][0]
    assert "denoised.html" in {path.name for path in tmp_path.iterdir()}


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_animals(tmp_path, monkeypatch):
    printed = run("05_animals.py", tmp_path, 1, monkeypatch)
    assert "21 joints, 10 frames at 10 fps" in printed

    def number(pattern: str) -> float:
        return float(re.search(pattern, printed)[1])

    assert number(r"mean error of bone lengths: ([\d.]+) %") < 10
    assert number(r"correct depth in (\d+)%") > 95
    assert number(r"mean joint error: (\d+) mm") < 80
    # The maximum acceleration at segment boundaries does not exceed that within segments.
    assert number(r"maximum acceleration ([\d.]+) times that within") <= 1
    rows = {mode: number(rf"{mode} +([\d.]+)") for mode in ("regression", "optimization")}
    assert rows["optimization"] < rows["regression"]
    assert 0.2 < number(r"relative to the animals: ([\d.]+)") < 1
    for name, labels in {
        "long": ["several codes"],
        "animals": ["draws", "seen by one camera", "the truth"],
        "own": ["shipped prior", "prior trained on these animals"],
    }.items():
        motions_by_label = animated_motions(tmp_path / f"{name}.html")
        assert list(motions_by_label) == labels
        for motions in motions_by_label.values():
            # In every skeleton at least one joint moves.
            assert (np.ptp(motions, axis=1).max(axis=(1, 2)) > 0.02).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_compare_and_calibrate(tmp_path, monkeypatch):
    printed = run("06_compare_and_calibrate.py", tmp_path, 3, monkeypatch)
    assert "every sampler had 20 000 evaluations" in printed
    table = Comparison.load(tmp_path / "comparison").table()
    used = table[table["metric"] == "budget_used"].groupby("sampler")["value"].max()
    assert (used[["mh", "mas"]] <= 20_000).all()
    assert 1e4 < (tmp_path / "report.html").stat().st_size < 15e6
    assert str(advise("gait-monocular")) in printed
    exact, narrow = (line for line in printed.splitlines() if " on gait-monocular(" in line)
    assert "no deviation found" in exact
    assert "overconfident: 90 % intervals" in narrow


@pytest.mark.slow
def test_exact_priors(tmp_path, monkeypatch):
    printed = run("07_exact_priors.py", tmp_path, 1, monkeypatch)
    seen, smoother = (
        float(re.search(rf"^{name}, mm +([\d.]+)", printed, re.MULTILINE)[1])
        for name in ("seen", "seen, smoother")
    )
    assert seen < smoother
    assert "exact on cmu-motion: right" in printed


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_from_video_to_blender(tmp_path, monkeypatch):
    printed = run("08_from_video_to_blender.py", tmp_path, 2, monkeypatch)
    pattern = r"mean error: (\d+) mm; 90 % intervals contain (\d+)%"
    error, contained = re.search(pattern, printed).groups()
    assert float(error) < 80
    assert 70 < float(contained) <= 100
    assert {path.suffix for path in (tmp_path / "walk").iterdir()} >= {".bvh", ".glb", ".html"}
    rows = {
        name: float(re.search(rf"^{name} +([\d.]+)", printed, re.MULTILINE)[1])
        for name in ("nothing given", "fov 40°", "fov 80°", "height 1.5 m")
    }
    # Distances are proportional to the focal length, fov is 60° by default, and to the height.
    for name, ratio in {"fov 40°": 1.59, "fov 80°": 0.69, "height 1.5 m": 1.5 / 1.7}.items():
        assert rows[name] / rows["nothing given"] == pytest.approx(ratio, rel=0.1)
    assert printed.count("Do not trust this motion") == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_from_one_image(tmp_path, monkeypatch):
    printed = run("09_from_one_image.py", tmp_path, 3, monkeypatch)
    assert "A body of the category quadruped explains the image." in printed
    error = float(re.search(r"^error of joints.* ([\d.]+)$", printed, re.MULTILINE)[1])
    assert error < 8
    # In all posteriors, depth is less certain than the place in the image.
    across, depth = (
        [float(value) for value in re.findall(rf"^{name}, mm +([\d.]+)", printed, re.MULTILINE)]
        for name in ("sd across the image", "sd in depth")
    )
    assert all(a < d for a, d in zip(across, depth, strict=True))
    assert {path.suffix for path in (tmp_path / "animal").iterdir()} >= {".glb", ".html", ".npz"}
    for shape in ("star", "square"):
        assert printed.count(f"a {shape}: Do not trust this reconstruction") == 1

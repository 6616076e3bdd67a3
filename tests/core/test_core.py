"""The core without optional libraries: sampling, comparing, lifting, denoising and files.

Continuous integration runs these tests in an environment with the core alone, and
``tests/test_extras.py`` in one in which the optional libraries cannot be imported.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import motion_files as files
import numpy as np
import pandas as pd
import pytest

import probmotion as pm
from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.extras import is_installed
from probmotion.io.keypoints.calibration import read_calibration
from probmotion.metrics.stein import NoGradient, score_of
from probmotion.posteriors.draws import MotionDraws, library_versions
from probmotion.posteriors.sampling import importable_samplers, sampler_names

PRIOR, MONOCULAR = "gait(frames=4)", "gait-monocular(frames=4)"
WALK = Path(__file__).parents[2] / "notebooks" / "keypoints" / "walk.json"


@pytest.mark.parametrize(
    ("sampler", "problem"),
    [
        *[(name, PRIOR) for name in ("exact", "ancestral3d", "mas", "mvpc", "mh", "ensemble")],
        *[(name, MONOCULAR) for name in ("exact", "ancestral3d", "split-gibbs", "mh")],
    ],
)
def test_draws_agree_with_exact_draws(sampler, problem):
    draws = pm.sample(problem, sampler, draws=100, chains=2, progress=False)
    metrics = pm.score(problem, draws).metrics
    # 1 is ideal; 100 draws that miss a style or are collapsed exceed 3.
    assert metrics["swd_ratio"] < 3
    assert 0.3 <= metrics["c2st"] < 0.85


def test_draws_are_stored_with_the_versions_of_installed_libraries(tmp_path):
    draws = pm.sample(MONOCULAR, draws=8, progress=False)
    draws.save(tmp_path / "draws.nc")
    stored = MotionDraws.load(tmp_path / "draws.nc")
    np.testing.assert_array_equal(stored.positions, draws.positions)
    versions = json.loads(stored.dataset.attrs["versions"])
    assert versions == library_versions()
    assert {"probmotion", "numpy", "scipy"} <= set(versions)


@pytest.mark.parametrize("suffix", [".npz", ".bvh", ".trc"])
def test_motions_are_written_and_read(suffix, tmp_path):
    walk = make_gait("walk", frames=12).retarget(pm.Skeleton.preset("person14"))
    pm.save(walk, tmp_path / f"walk{suffix}")
    read = pm.read_joints(tmp_path / f"walk{suffix}").joints
    np.testing.assert_allclose(read, walk.positions, atol=0.02)


@pytest.mark.parametrize("suffix", [".glb", ".csv"])
def test_motions_are_written_for_other_programs(suffix, tmp_path):
    pm.save(make_gait("walk", frames=12), tmp_path / f"walk{suffix}")
    content = (tmp_path / f"walk{suffix}").read_bytes()
    assert content.startswith(b"glTF") if suffix == ".glb" else content.count(b"\n") > 12


@pytest.mark.filterwarnings("ignore::probmotion.io.errors.MotionFileWarning")
def test_motions_and_cameras_of_other_programs_are_read(tmp_path):
    for name, content in (
        ("clip.asf", files.ASF),
        ("clip.amc", files.AMC),
        ("c.toml", files.CAMERAS),
    ):
        (tmp_path / name).write_bytes(content)
    assert pm.load(tmp_path / "clip.amc", up="y").frames == 2
    assert read_calibration(tmp_path / "c.toml").names == ("left",)


@pytest.mark.filterwarnings("ignore::probmotion.io.errors.MotionFileWarning")
@pytest.mark.parametrize(
    ("suffix", "contents"),
    {
        ".json": files.JSONS,  # COCO, AlphaPose, OpenPose, MMPose, RTMPose, MediaPipe
        ".csv": [files.TABLE, files.LANDMARK_TABLE],  # DeepLabCut, MediaPipe
        ".h5": files.HDF5,  # SLEAP, movement, DeepLabCut
        ".npz": files.ARCHIVES[1:],
    }.items(),
)
def test_keypoints_of_every_detector_are_read(suffix, contents, tmp_path):
    for content in contents:
        (tmp_path / f"clip{suffix}").write_bytes(content)
        for track in pm.read_keypoints(tmp_path / f"clip{suffix}", fps=30):
            assert track.keypoints.size
            assert (track.confidence > 0).any()


def test_a_comparison_has_a_table_a_report_and_rows_of_samplers_without_their_extra(
    capsys, tmp_path
):
    words = ["compare", MONOCULAR, "--quick", "--draws", "40", "--seconds", "0.3"]
    words += [
        "--workers",
        "0",
        "--out",
        str(tmp_path),
        "--report",
        "--figures",
        "--samplers",
        "exact",
        "mh",
    ]
    missing = [] if is_installed("jax") else ["nuts", "tempered"]
    assert main([*words, *missing]) == 0
    rows = pd.read_csv(tmp_path / "table.csv")
    assert {"swd_ratio", "c2st", "mmd"} <= set(rows["metric"][rows["sampler"] == "exact"])
    assert "C2ST" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert list(tmp_path.glob("quality_against_cost.*"))
    if missing:
        text = capsys.readouterr().out
        assert text.count("failed (not installed)") == 2
        assert "jax must be installed; run pip install 'probmotion[jax]'" in text
    without_gradients = library_versions().keys().isdisjoint({"jax", "torch"})
    notes = (tmp_path / "table.txt").read_text(encoding="utf-8")
    assert ("KSD² is not measured" in notes) == without_gradients


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor])
def test_runs_in_worker_processes_and_threads_have_draws(executor, tmp_path):
    with executor(1) if executor else nullcontext() as used:
        options = {"draws": 20, "out": tmp_path, "progress": False, "executor": used}
        grid = pm.compare(PRIOR, "exact", **options)
    assert [run.failure for run in grid.results] == [None]


def test_a_video_is_lifted(capsys, tmp_path):
    words = ["lift", str(WALK), "--image-size", "1000", "1000", "--draws", "2"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    assert "wrote" in capsys.readouterr().out
    assert pm.load(tmp_path / "lift.bvh").frames == 75
    assert (tmp_path / "lift.html").stat().st_size > 3e4


def test_a_recording_is_denoised(tmp_path):
    walk = make_gait("walk", frames=30).retarget(pm.Skeleton.preset("person14"))
    noisy = walk.positions + 0.03 * np.random.default_rng(0).standard_normal(walk.positions.shape)
    path = tmp_path / "walk.npz"
    pm.save(pm.Motion(noisy, walk.skeleton, walk.fps), path)
    assert main(["denoise", str(path), "--out", str(tmp_path), "--draws", "2"]) == 0
    mean = pm.load(tmp_path / "denoised.npz").positions
    errors = [np.linalg.norm(each - walk.positions, axis=-1).mean() for each in (mean, noisy)]
    assert errors[0] < 0.7 * errors[1]


def test_all_samplers_and_problems_are_listed(capsys):
    assert list(importable_samplers()) == sampler_names()
    assert main(["list"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in ("nuts", "dvae", "walk-vae", "dance-pairs"))
    assert main(["show", "walk2d"]) == 0


def test_scores_without_gradients_are_refused():
    if is_installed("torch") or is_installed("jax"):
        pytest.skip("torch or jax is installed")
    posterior = pm.problem(MONOCULAR).posterior
    with pytest.raises(NoGradient, match=r"torch must be installed; run pip .* jax must be inst"):
        score_of(posterior, posterior.initial(np.random.default_rng(0), 3))


def lift_person():
    from probmotion.models.pose_pairs import lift_person

    return lift_person


@pytest.mark.parametrize(
    ("library", "extra", "call"),
    [
        ("torch", "torch", lambda: pm.models.MotionVAE),
        ("torch", "torch", lambda: pm.problem("walk2d")),
        ("torch", "torch", lambda: pm.sample(PRIOR, "dvae", draws=4, progress=False)),
        ("jax", "jax", lambda: pm.sample(PRIOR, "nuts", draws=4, progress=False)),
        ("jax", "jax", lambda: pm.sample(MONOCULAR, "smc", draws=4, progress=False)),
        ("numba", "fast", lambda: pm.problem("dance-pairs")),
        ("numba", "fast", lift_person),
        ("zarr", "stream", lambda: pm.sample(PRIOR, draws=4, progress=False, stream="run")),
    ],
)
def test_missing_libraries_are_named_with_the_command_that_installs_them(
    library, extra, call, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    if is_installed(library):
        pytest.skip(f"{library} is installed")
    sentence = rf"^{library} must be installed; run pip install 'probmotion\[{extra}\]'$"
    with pytest.raises(ModuleNotFoundError, match=sentence):
        call()

"""The command ``probmotion denoise``; most tests replace the posterior by a stand-in."""

from types import SimpleNamespace

import numpy as np
import pytest

from probmotion import Skeleton, load
from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait

PERSON = Skeleton.preset("person14")
WRIST, NECK = PERSON.index("left_wrist"), PERSON.index("neck")
WALK = make_gait("walk", frames=20, fps=60.0).retarget(PERSON).positions


@pytest.fixture
def calls(monkeypatch):
    """Replace the posterior by one whose mean is the walk in gaps, and record its arguments."""
    recorded = []

    def denoise_joints(joints, confidence, **options):
        recorded.append((joints, confidence, options))
        gaps = np.isnan(joints)
        mean, sd = (
            np.where(gaps, WALK, joints) if gaps.any() else joints,
            np.where(gaps, 0.05, 0.01),
        )
        draws = np.repeat(mean[None], options["draws"], axis=0)
        noise = 0.02 if options["noise"] is None else options["noise"]
        return SimpleNamespace(mean=mean, sd=sd, draws=draws, noise=noise)

    monkeypatch.setattr("probmotion.models.mixture.denoising.denoise_joints", denoise_joints)
    return recorded


def record(path, **changes):
    """Write the walk with gaps: the left wrist for half the time, the neck always."""
    positions = WALK.copy()
    positions[:10, WRIST] = positions[:, NECK] = np.nan
    arrays = {"positions": positions, "fps": 60.0, "joint_names": PERSON.joint_names}
    np.savez(path, **(arrays | {"parents": PERSON.parents} | changes))
    return positions


def test_gaps_are_filled_and_noise_is_reduced(capsys, tmp_path):
    walk = make_gait("walk", frames=90, fps=30.0).retarget(PERSON).positions
    joints = walk + 0.03 * np.random.default_rng(0).standard_normal(walk.shape)
    hidden = np.zeros(walk.shape[:2], bool)
    hidden[20:45, WRIST] = hidden[:, NECK] = True
    np.savez(tmp_path / "walk.npz", positions=np.where(hidden[..., None], np.nan, joints), fps=30.0,
             joint_names=PERSON.joint_names, parents=PERSON.parents)  # fmt: skip
    words = ["denoise", str(tmp_path / "walk.npz"), "--out", str(tmp_path), "--draws", "3"]
    assert main(words) == 0
    assert "noise: " in capsys.readouterr().out
    with np.load(tmp_path / "denoised.npz") as archive:
        found, sd, noise = archive["positions"], archive["sd"], float(archive["noise"])
    assert 0.015 < noise < 0.06
    error = np.linalg.norm(found - walk, axis=-1)
    assert error[~hidden].mean() < 0.7 * np.linalg.norm(joints - walk, axis=-1)[~hidden].mean()
    assert error[hidden].mean() < 0.12
    assert sd[20:45, WRIST].mean() > 2 * sd[~hidden].mean()
    # The neck is known better, from the shoulders.
    assert sd[20:45, WRIST].mean() > sd[:, NECK].mean() > 1.5 * sd[~hidden].mean()


def test_files_and_summary(calls, capsys, tmp_path):
    positions = record(tmp_path / "walk.npz")
    out = tmp_path / "new" / "out"
    words = ["denoise", str(tmp_path / "walk.npz"), "--out", str(out)]
    assert main([*words, "--draws", "3", "--outliers", "--seed", "5"]) == 0
    ((joints, confidence, options),) = calls
    np.testing.assert_array_equal(joints, positions)
    assert confidence is None
    assert options.pop("skeleton") == PERSON
    assert options == {
        "fps": 60.0, "noise": None, "degrees_of_freedom": 3.0, "draws": 3, "seed": 5,
        "progress": True,
    }  # fmt: skip
    assert capsys.readouterr().out.splitlines() == [
        f"{tmp_path / 'walk.npz'}: 20 frames at 60 fps, 14 joints, 10.7% of joint positions missing"
        "; never observed, filled by the prior: neck",
        "noise: 2 cm (estimated); mean posterior standard deviation: 1 cm at observed joints, 5 cm "
        "at missing joints",
        f"wrote {out / 'denoised.npz'} (mean, standard deviation and 3 draws) and "
        f"{out / 'mean.bvh'} (mean)",
    ]
    assert sorted(path.name for path in out.iterdir()) == ["denoised.npz", "mean.bvh"]
    mean = load(out / "denoised.npz")
    np.testing.assert_array_equal(mean.positions, WALK)
    np.testing.assert_allclose(load(out / "mean.bvh").positions, WALK, atol=1e-5)
    assert (mean.skeleton, mean.fps, mean.name) == (PERSON, 60.0, "walk")
    with np.load(out / "denoised.npz") as archive:
        np.testing.assert_array_equal(archive["sd"], np.where(np.isnan(positions), 0.05, 0.01))
        np.testing.assert_array_equal(archive["draws"], [mean.positions] * 3)
        assert archive["noise"] == 0.02
    # The same folder again: the files are replaced.
    assert main([*words, "--noise", "0.03"]) == 0
    assert calls[1][2]["noise"] == 0.03
    assert calls[1][2]["degrees_of_freedom"] is None
    with np.load(out / "denoised.npz") as archive:
        assert archive["draws"].shape == (20, 20, 14, 3)


def test_the_mean_is_corrected_on_request(calls, monkeypatch, tmp_path):
    record(tmp_path / "walk.npz")

    def correct_joints(found, *, fps, corrector, seed):
        assert corrector.skeleton == PERSON
        assert (fps, seed) == (60.0, 5)
        return SimpleNamespace(**(vars(found) | {"mean": found.mean + 1}))

    monkeypatch.setattr("probmotion.problems.joint_correction.correct_joints", correct_joints)
    words = ["denoise", str(tmp_path / "walk.npz"), "--out", str(tmp_path / "out"), "--seed", "5"]
    assert main([*words, "--correct"]) == 0
    np.testing.assert_array_equal(load(tmp_path / "out" / "denoised.npz").positions, WALK + 1)


@pytest.mark.parametrize("name", ["h36m17", "coco17"])
def test_other_skeletons_are_retargeted(name, calls, tmp_path):
    skeleton = Skeleton.preset(name)
    source = [PERSON.index(n) if n in PERSON.joint_names else NECK for n in skeleton.joint_names]
    np.savez(tmp_path / "walk.npz", positions=WALK[:, source], fps=30.0,
             joint_names=skeleton.joint_names, parents=skeleton.parents)  # fmt: skip
    assert main(["denoise", str(tmp_path / "walk.npz"), "--out", str(tmp_path)]) == 0
    ((given, _, options),) = calls
    assert options["skeleton"] == PERSON
    missing = [joint for joint in PERSON.joint_names if joint not in skeleton.joint_names]
    assert missing == (["pelvis", "neck"] if name == "coco17" else [])
    expected = WALK.copy()
    expected[:, [PERSON.index(joint) for joint in missing]] = np.nan
    np.testing.assert_array_equal(given, expected)


def test_invalid_input_is_one_sentence(calls, fails, tmp_path):
    path = tmp_path / "walk.npz"
    positions = record(path)
    out = ["--out", tmp_path / "out"]
    assert fails("denoise", path, *out, "--noise", "-0.1") == (
        "noise must be a finite number above 0, got -0.1"
    )
    assert fails("denoise", path, *out, "--noise", "20") == (
        "noise must be at most 1 m, got 20; is it in metres?"
    )
    assert fails("denoise", path, *out, "--draws", "0").startswith("draws must be an integer of at")
    assert fails("denoise", tmp_path / "no.trc", *out).endswith("no.trc: No such file or directory")
    record(path, positions=np.full_like(positions, np.nan))
    assert fails("denoise", path, *out).endswith("observed in at least one frame, got only gaps")
    record(path, positions=1000 * positions)
    assert "pass unit='mm' (--unit mm)" in fails("denoise", path, *out)
    dog = Skeleton.preset("apt36k17")
    noise = np.random.default_rng(0).normal(size=(20, 17, 3))
    record(path, positions=noise, joint_names=dog.joint_names, parents=dog.parents)
    message = fails("denoise", path, *out, "--unit", "m", "--up", "y")
    assert "joints must include left_wrist, right_wrist" in message
    path.write_bytes(b"")
    assert "expected an npz archive" in fails("denoise", path, *out)
    (tmp_path / "out").write_text("")
    record(path)
    assert "out must be a writable folder" in fails("denoise", path, *out)
    assert not calls

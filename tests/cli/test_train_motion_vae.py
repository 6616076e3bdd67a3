"""``probmotion train motion-vae``: a prior over 3D motion from files of 2D tracks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.cli.main import main
from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.io.files import save
from probmotion.io.keypoints.files import read_keypoints
from probmotion.models.vae.motion_vae import MotionVAE

PERSON = Skeleton.preset("person14")


def write(track, path):
    names, parents = np.array(track.skeleton.joint_names), np.array(track.skeleton.parents)
    arrays = {"keypoints": track.keypoints, "confidence": track.confidence, "fps": track.fps}
    np.savez(path, joint_names=names, parents=parents, **arrays)


@pytest.fixture(scope="module")
def tracks(tmp_path_factory):
    """File name pattern of 2D tracks of five clips, each from six sides."""
    folder = tmp_path_factory.mktemp("tracks")
    clips = [clip.retarget(PERSON) for clip in make_gaits(5, styles={"walk": 1.0}, frames=60)]
    for track in project_clips(clips, views=6, noise=DetectorNoise.none()):
        write(track, folder / f"{track.name.replace('/', '-')}.npz")
    return str(folder / "walk-*.npz")


def command(tracks, out, *more):
    parts = ["--validation", "walk-3-0", "walk-3-1", "--test", "walk-4-0"]
    args = ["train", "motion-vae", "--tracks", tracks, "--size", "tiny", *parts]
    return [*args, "--out", str(out), *map(str, more)]


def test_prior_of_3d_motion_from_2d_tracks(tracks, tmp_path, capsys, fails):
    out = tmp_path / "run"
    assert main(command(tracks, out, "--steps", 4)) == 0
    printed = capsys.readouterr().out
    assert "rest pose: the mean pose, estimated from the tracks" in printed
    assert f"wrote {out / 'poses' / 'model.safetensors'}: step 4" in printed
    prior = MotionVAE.load(out / "vae", codes=None)
    assert (prior.skeleton, prior.fps, prior.frames) == (PERSON, 10.0, 10)
    assert prior.sample(np.random.default_rng(0), 2).shape == (2, 10, 14, 3)
    assert prior.card["network"]["distance"] is None
    # More steps extend the training of the VAE and leave the pose network unchanged.
    poses = (out / "poses" / "model.safetensors").read_bytes()
    assert main(command(tracks, out, "--steps", 6)) == 0
    assert "step 6, loss" in capsys.readouterr().out
    assert (out / "poses" / "model.safetensors").read_bytes() == poses
    assert "size" in fails(*command(tracks, out, "--steps", 6), "--size", "small")


def test_invalid_options_give_one_error_line(tracks, tmp_path, fails):
    for options, expected in {
        "--frames 80": "80",
        "--centre sequence": "centre must be 'frame', got 'sequence'",
        "--distance 0": "distance must be a finite number above 0, got 0.0",
        "--threshold 0": "threshold must be a finite number above 0, got 0.0",
        "--rest no.npz": "no.npz",
        "--kl -1": "kl must be a finite number of at least 0, got -1.0",
    }.items():
        assert expected in fails(*command(tracks, tmp_path / "run", "--steps", 2), *options.split())


def changed(pattern, folder, change):
    """Write changed copies of the tracks; return their pattern."""
    for path in Path(pattern).parent.glob(Path(pattern).name):
        write(change(read_keypoints(path)[0]), folder / path.name)
    return str(folder / Path(pattern).name)


def test_short_motions_with_a_given_rest_pose_and_weight(tracks, tmp_path, capsys, fails):
    walk = make_gaits(1, styles={"walk": 1.0}, frames=2)[0]
    pose, out = tmp_path / "rest.npz", tmp_path / "run"
    save(walk, pose)

    def shortened(track):
        return replace(track, keypoints=track.keypoints[:14], confidence=track.confidence[:14])

    short = changed(tracks, tmp_path, shortened)
    more = ["--steps", 2, "--frames", 5, "--rest", pose, "--kl", 0.02]
    assert main(command(short, out, *more)) == 0
    assert f"rest pose: the first frame of {pose}" in capsys.readouterr().out
    prior = MotionVAE.load(out / "vae", codes=None)
    assert prior.settings.kl == 0.02
    expected = walk.retarget(PERSON).positions[0]
    np.testing.assert_allclose(prior.body.rest_positions, expected - expected[0], atol=1e-6)
    message = fails(*command(short, tmp_path / "other", "--steps", 2))
    assert message.endswith("10 frames at 10 fps; the longest track has 5")


def test_tracks_without_the_root_are_rejected(tracks, tmp_path, fails):
    def without_root(track):
        confidence = track.confidence.copy()
        confidence[:, PERSON.index("pelvis")] = 0.0
        return replace(track, confidence=confidence)

    args = command(changed(tracks, tmp_path, without_root), tmp_path / "run", "--steps", 2)
    assert "tracks without the root (pelvis)" in fails(*args)


@pytest.mark.filterwarnings("always:body is not left-right symmetric")
def test_own_skeleton_without_left_right_pairs(tracks, tmp_path, capsys):
    leg = Skeleton(["trunk", "thigh", "knee", "foot", "top"], [-1, 0, 1, 2, 0])
    joints = ["pelvis", "right_hip", "right_knee", "right_ankle", "neck"]
    index = [PERSON.index(joint) for joint in joints]

    def one_leg(track):
        keypoints, confidence = track.keypoints[:, index], track.confidence[:, index]
        return replace(track, keypoints=keypoints, confidence=confidence, skeleton=leg)

    args = command(changed(tracks, tmp_path, one_leg), tmp_path / "run", "--steps", 2)
    assert main([*args, "--skeleton", "own", "--front", "knee"]) == 0
    assert "body is not left-right symmetric" in capsys.readouterr().err
    assert MotionVAE.load(tmp_path / "run" / "vae", codes=None).skeleton == leg

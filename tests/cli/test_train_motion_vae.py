"""``probmotion train motion-vae``: from files that hold 2D alone to a prior over 3D motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.cli.main import main
from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.animals import ANIMAL_SKELETON, synthetic_animals
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.io.files import read_keypoints, save_motion
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.motion.motion import KeypointTrack

PERSON = Skeleton.preset("person14")
PARENTS = list(ANIMAL_SKELETON.parents[1:])


def keep(track: KeypointTrack, path: Path) -> None:
    np.savez(
        path,
        keypoints=track.keypoints,
        confidence=track.confidence,
        joint_names=np.array(track.skeleton.joint_names),
        parents=np.array(track.skeleton.parents),
        fps=track.fps,
    )


@pytest.fixture(scope="module")
def tracks(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A pattern of files of 2D tracks: five clips, each from six sides."""
    folder = tmp_path_factory.mktemp("tracks")
    clips = [clip.retarget(PERSON) for clip in make_gaits(5, styles={"walk": 1.0}, frames=60)]
    for track in project_clips(clips, views=6, noise=DetectorNoise.none()):
        keep(track, folder / f"{track.name.replace('/', '-')}.npz")
    return str(folder / "walk-*.npz")


def words(tracks: str, out: Path, *more: object) -> list[str]:
    parts = ["--validation", "walk-3-0", "walk-3-1", "--test", "walk-4-0"]
    given = ["train", "motion-vae", "--tracks", tracks, "--size", "tiny", *parts]
    return [*given, "--out", str(out), *map(str, more)]


def test_a_prior_of_3d_motion_comes_from_files_of_2d_tracks(
    tracks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(words(tracks, out, "--steps", 4)) == 0
    said = capsys.readouterr().out
    assert "the rest pose is the mean pose, estimated from the tracks" in said
    assert f"wrote {out / 'poses' / 'model.safetensors'}: step 4" in said
    prior = MotionVAE.load(out / "vae")
    assert (prior.skeleton, prior.fps, prior.frames) == (PERSON, 10.0, 10)
    assert prior.sample(np.random.default_rng(0), 2).shape == (2, 10, 14, 3)
    assert prior.card["network"]["distance"] is None
    # More steps are steps of the VAE; the poses stay.
    poses = (out / "poses" / "model.safetensors").read_bytes()
    assert main(words(tracks, out, "--steps", 6)) == 0
    assert "step 6, loss" in capsys.readouterr().out
    assert (out / "poses" / "model.safetensors").read_bytes() == poses


def test_a_rest_pose_and_a_weight_may_be_given(
    tracks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = make_gaits(1, styles={"walk": 1.0}, frames=2)[0]
    pose = tmp_path / "rest.npz"
    save_motion(walk, pose)
    more = ["--steps", 2, "--rest", pose, "--kl", 0.02]
    assert main(words(tracks, tmp_path / "run", *more)) == 0
    assert f"the rest pose is the first frame of {pose}" in capsys.readouterr().out
    prior = MotionVAE.load(tmp_path / "run" / "vae")
    assert prior.settings.kl == 0.02
    expected = walk.retarget(PERSON).positions[0]
    np.testing.assert_allclose(prior.body.rest_positions, expected - expected[0], atol=1e-6)


def table_of(track: KeypointTrack, path: Path) -> None:
    """Write a track as DeepLabCut writes it: pixels, y down, nothing where nothing was found."""
    names = [name for name in track.skeleton.joint_names for _ in range(3)]
    lines = [
        ",".join(["scorer", *["net"] * len(names)]),
        ",".join(["bodyparts", *names]),
        ",".join(["coords", *["x", "y", "likelihood"] * track.skeleton.n_joints]),
    ]
    pixels = 640 + 250 * track.keypoints
    for frame, (points, trusted) in enumerate(zip(pixels, track.confidence, strict=True)):
        found = [
            f"{x:.2f},{y:.2f},{likelihood:.2f}" if np.isfinite(x) else ",,"
            for (x, y), likelihood in zip(points, trusted, strict=True)
        ]
        lines.append(",".join([str(frame), *found]))
    path.write_text("\n".join(lines) + "\n")


def test_an_animal_of_one_s_own_comes_from_a_detector_s_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clips = [clip.retarget(ANIMAL_SKELETON) for clip in synthetic_animals(4, seed=1)]
    for track in project_clips(clips, views=3):
        table_of(track, tmp_path / f"{track.name.replace('/', '-')}.csv")
    names = sorted(path.stem for path in tmp_path.glob("*.csv"))
    given = ["train", "motion-vae", "--tracks", str(tmp_path / "*.csv")]
    given += ["--skeleton", "quadruped21"]
    given += ["--tracks-fps", str(clips[0].fps), "--threshold", "0.5", "--size", "tiny"]
    given += ["--validation", *names[-3:], "--test", names[0], "--out", str(tmp_path / "run")]
    assert main([*given, "--steps", "3"]) == 0, capsys.readouterr().err
    assert "the rest pose is the mean pose, estimated from the tracks" in capsys.readouterr().out
    prior = MotionVAE.load(tmp_path / "run" / "vae")
    assert prior.skeleton == ANIMAL_SKELETON
    assert prior.sample(np.random.default_rng(0), 2).shape == (2, 10, 21, 3)
    # Of pixels only proportions can be known.
    shown = np.linalg.norm(prior.body.rest, axis=-1)[1:]
    true = np.linalg.norm(clips[0].positions[0, 1:] - clips[0].positions[0, PARENTS], axis=-1)
    np.testing.assert_allclose(shown / shown.sum(), true / true.sum(), atol=0.02)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--frames", "80"], "tracks has at most "),
        (["--centre", "sequence"], "centre must be 'frame', got 'sequence'"),
        (["--distance", "0"], "distance must be a finite number above 0, got 0.0"),
        (["--threshold", "0"], "threshold must be a finite number above 0, got 0.0"),
        (["--rest", "no.npz"], "no.npz"),
        (["--kl", "-1"], "kl is -1.0, expected"),
    ],
)
def test_wrong_options_are_one_sentence(
    tracks: str, tmp_path: Path, more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words(tracks, tmp_path / "run", "--steps", 2, *more)) == 2
    (line,) = (
        part for part in capsys.readouterr().err.splitlines() if part.startswith("probmotion: ")
    )
    assert said in line


def changed(pattern: str, folder: Path, change: Callable[[KeypointTrack], KeypointTrack]) -> str:
    """Write the tracks of other files anew, each of them changed; return their pattern."""
    for path in Path(pattern).parent.glob(Path(pattern).name):
        keep(change(read_keypoints(path)[0]), folder / path.name)
    return str(folder / Path(pattern).name)


def first(frames: int) -> Callable[[KeypointTrack], KeypointTrack]:
    def change(track: KeypointTrack) -> KeypointTrack:
        return replace(
            track, keypoints=track.keypoints[:frames], confidence=track.confidence[:frames]
        )

    return change


def test_tracks_as_long_as_the_motions_are_long_enough(
    tracks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    brief = changed(tracks, tmp_path, first(14))
    assert main(words(brief, tmp_path / "run", "--steps", 2, "--frames", 5)) == 0
    capsys.readouterr()
    assert main(words(brief, tmp_path / "other", "--steps", 2)) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.endswith("10 frames at 10 per second, of which the longest has 5")


def test_a_root_that_is_never_seen_is_named(
    tracks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def hidden(track: KeypointTrack) -> KeypointTrack:
        confidence = track.confidence.copy()
        confidence[:, PERSON.index("pelvis")] = 0.0
        return replace(track, confidence=confidence)

    assert main(words(changed(tracks, tmp_path, hidden), tmp_path / "run", "--steps", 2)) == 2
    assert "tracks never showed it (pelvis)" in capsys.readouterr().err


def test_a_folder_of_another_size_is_refused(
    tracks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(words(tracks, out, "--steps", 2)) == 0
    assert main([*words(tracks, out, "--steps", 2), "--size", "small"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.endswith("another size, expected the same; give it a folder of its own")


@pytest.mark.filterwarnings("always:body has no left-right pairs")
def test_a_skeleton_of_one_s_own_without_pairs_is_learnt_and_said_so(
    tracks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    leg = Skeleton(["trunk", "thigh", "knee", "foot", "top"], [-1, 0, 1, 2, 0])
    joints = ["pelvis", "right_hip", "right_knee", "right_ankle", "neck"]
    held = [PERSON.index(joint) for joint in joints]

    def one_leg(track: KeypointTrack) -> KeypointTrack:
        return replace(
            track,
            keypoints=track.keypoints[:, held],
            confidence=track.confidence[:, held],
            skeleton=leg,
        )

    own = changed(tracks, tmp_path, one_leg)
    more = ["--steps", 2, "--skeleton", "own", "--front", "knee"]
    assert main(words(own, tmp_path / "run", *more)) == 0, capsys.readouterr().err
    assert "body has no left-right pairs: no bone is as long as its" in capsys.readouterr().err
    assert MotionVAE.load(tmp_path / "run" / "vae").skeleton == leg
    assert main(["train", "motion-vae", "--skeleton", "own", "--out", str(tmp_path / "no")]) == 2
    assert "skeleton is 'own' without tracks, expected --tracks" in capsys.readouterr().err

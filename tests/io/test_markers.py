"""Joint tracks with gaps from TRC, C3D and npz files."""

import sys

import ezc3d
import numpy as np
import pytest

from probmotion import Skeleton, load, read_joints, save
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.errors import MotionFileError, MotionFileWarning

PERSON = Skeleton.preset("person14")
OPENPOSE = {
    name: f"{name[0].upper()}{name.partition('_')[2].capitalize()}"
    for name in PERSON.joint_names
    if "_" in name
}
Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def walk():
    return make_gait("walk", frames=12, fps=60.0).retarget(PERSON)


def write_trc(path, points, names, unit="mm", fps=60.0):
    """Write markers (L, M, 3); NaN becomes empty cells."""
    rows = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"],
        [f"{fps:g}", f"{fps:g}", str(len(points)), str(len(names)), unit],
        ["Frame#", "Time", *(cell for name in names for cell in (name, "", ""))],
        ["", "", *(f"{axis}{m}" for m in range(1, len(names) + 1) for axis in "XYZ")],
        [],
    ]
    for frame, pose in enumerate(points):
        cells = ["" if np.isnan(x) else f"{x:.6f}" for x in pose.ravel()]
        rows.append([str(frame + 1), f"{frame / fps:.5f}", *cells])
    path.write_text("\n".join("\t".join(row) for row in rows) + "\n", encoding="utf-8")


def write_c3d(path, points, names, unit="mm", fps=60.0):
    """Write markers (L, M, 3); NaN becomes a negative residual."""
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [fps]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["data"]["points"] = np.concatenate([points.T, np.ones((1, *points.T.shape[1:]))])
    file.write(str(path))


WRITERS = {".trc": write_trc, ".c3d": write_c3d}


@pytest.mark.parametrize("suffix", WRITERS)
def test_markers_in_millimetres_with_z_up_become_joints_of_person14(suffix, walk, tmp_path):
    """The neck is no marker, the last marker is no joint, and one gap is written as zeros."""
    path = tmp_path / f"walk{suffix}"
    names = [name for name in PERSON.joint_names if name != "neck"]
    points = 1000 * walk.positions[:, [PERSON.index(name) for name in names]] @ Z_UP_FROM_Y_UP.T
    points = np.concatenate([points, points[:, :1] + 50], axis=1)
    points[3:6, names.index("left_wrist")] = np.nan
    points[8, names.index("right_knee")] = 0.0
    labels = [OPENPOSE.get(name, "MidHip") for name in names]
    WRITERS[suffix](path, points, [*labels, "LFHD"])
    with pytest.raises(MotionFileError, match=r"stand along Z; pass up='z' \(--up z\)"):
        read_joints(path)
    track = read_joints(path, up="z")
    assert (track.name, track.fps, track.skeleton) == ("walk", 60.0, PERSON)
    seen = np.ones((12, 14), bool)
    seen[:, PERSON.index("neck")] = False
    seen[3:6, PERSON.index("left_wrist")] = False
    seen[8, PERSON.index("right_knee")] = False
    np.testing.assert_array_equal(track.seen, seen)
    np.testing.assert_allclose(track.joints[seen], walk.positions[seen], atol=2e-7)
    mirrored = points * [-1, 1, 1]
    WRITERS[suffix](path, mirrored, [*labels, "LFHD"])
    with pytest.warns(MotionFileWarning, match="left joints are on the body's right"):
        read_joints(path, up="z")
    again = read_joints(path, up="z", mirror=True).joints
    np.testing.assert_allclose(again, track.joints, atol=1e-9)


@pytest.mark.parametrize("suffix", WRITERS)
def test_wrong_and_unknown_units_name_the_option(suffix, walk, tmp_path):
    path, names = tmp_path / f"walk{suffix}", list(PERSON.joint_names)
    WRITERS[suffix](path, 1000 * walk.positions, names, unit="m")
    with pytest.raises(MotionFileError, match=r"bodies must be 0\.3 to 3 m .*--unit mm"):
        read_joints(path)
    np.testing.assert_allclose(read_joints(path, unit="mm").joints, walk.positions, atol=1e-6)
    WRITERS[suffix](path, walk.positions, names, unit="furlong")
    with pytest.raises(MotionFileError, match="unit must be one of m, cm, mm, in, got 'furlong'"):
        read_joints(path)


@pytest.mark.parametrize("suffix", WRITERS)
def test_markers_that_are_not_joints_are_refused_with_what_is_needed(suffix, walk, tmp_path):
    path, names = tmp_path / f"walk{suffix}", list(PERSON.joint_names)
    WRITERS[suffix](path, walk.positions, [f"M{m}" for m in range(14)], unit="m")
    message = (
        r"joints must include left_shoulder, .*, got only M0, M1, .*; markers must be joint ce"
    )
    with pytest.raises(MotionFileError, match=message):
        read_joints(path)
    centres = {"shoulder": "SJC", "elbow": "EJC", "wrist": "WJC", "hip": "HJC", "knee": "KJC",
               "ankle": "AJC"}  # fmt: skip
    labels = [n if "_" not in n else n[0].upper() + centres[n.split("_")[1]] for n in names]
    WRITERS[suffix](path, walk.positions, labels, unit="m")
    np.testing.assert_allclose(read_joints(path).joints, walk.positions, atol=1e-6)
    WRITERS[suffix](path, np.full_like(walk.positions, np.nan), names, unit="m")
    with pytest.raises(MotionFileError, match="observed in at least one frame, got only gaps"):
        read_joints(path)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: "", "expected a TRC file"),
        (lambda text: text.replace("NumFrames", "Frames"), "line 2: expected the key NumFrames"),
        (lambda text: text.replace("\t14\t", "\t15\t"), "expected 15 markers, got 14"),
        (lambda text: text[: text.rindex("\n12\t") + 1], "expected 12 frames, got 11"),
        (lambda text: text[:-1] + "\t1.0\n", "line 18: expected 42 coordinates, got 43"),
        (lambda text: text[: text.rindex("\t")] + "\tx\n", "line 18: expected a number"),
        (lambda text: text[: text.rindex("\t")], "NaN in all coordinates where missing"),
    ],
)
def test_damaged_trc_files_are_refused(edit, message, walk, tmp_path):
    path = tmp_path / "walk.trc"
    write_trc(path, walk.positions, list(PERSON.joint_names), "m")
    path.write_text(edit(path.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(MotionFileError, match=message):
        read_joints(path)


def test_c3d_needs_the_extra_and_a_c3d_file(monkeypatch, tmp_path):
    path = tmp_path / "walk.c3d"
    with pytest.raises(FileNotFoundError):
        read_joints(path)
    for content in (b"", b"hello" * 500):
        path.write_bytes(content)
        with pytest.raises(MotionFileError, match="expected a C3D file"):
            read_joints(path)
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'probmotion\[c3d\]'"):
        read_joints(path)


def test_npz_with_gaps_and_motion_files_become_tracks(walk, tmp_path):
    save(walk, tmp_path / "walk.npz")
    save(walk, tmp_path / "walk.bvh")
    np.testing.assert_allclose(read_joints(tmp_path / "walk.bvh").joints, walk.positions, atol=1e-5)
    arrays = dict(np.load(tmp_path / "walk.npz"))
    arrays["positions"] = 100 * arrays["positions"]
    arrays["positions"][2:5, 3] = np.nan
    np.savez(tmp_path / "gaps.npz", **arrays)
    track = read_joints(tmp_path / "gaps.npz", unit="cm")
    assert np.argwhere(~track.seen).tolist() == [[2, 3], [3, 3], [4, 3]]
    np.testing.assert_allclose(track.joints[track.seen], walk.positions[track.seen])
    with pytest.raises(MotionFileError, match="--unit cm"):
        read_joints(tmp_path / "gaps.npz")
    with pytest.raises(MotionFileError, match="must be finite"):
        load(tmp_path / "gaps.npz", unit="cm")
    arrays["positions"] = np.stack([arrays["positions"]] * 2, axis=1)
    np.savez(tmp_path / "pair.npz", **arrays)
    with pytest.raises(MotionFileError, match="must be of one person, got 2 people"):
        read_joints(tmp_path / "pair.npz")


def test_a_real_trc_file(real_data):
    (path,) = (real_data / "originals").glob("*.trc")
    track = read_joints(path)
    assert (track.frames, track.fps) == (100, 60.0)
    assert [PERSON.joint_names[j] for j in np.flatnonzero(~track.seen[0])] == ["pelvis"]
    hip = track.joints[0, PERSON.index("right_hip")]
    np.testing.assert_allclose(hip, [-0.0649977688, 0.9015132201, -1.4005735926], atol=1e-9)

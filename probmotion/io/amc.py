"""Reader of AMC motion files and their ASF skeletons.

A bone with axes C (:mod:`probmotion.io.asf`) and channel rotation M is rotated by C M C⁻¹ relative
to its parent; the first channel listed is applied first. The end of a bone is the end of its
parent plus the rotated offset of the bone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probmotion.geometry.rotations import euler_to_matrix
from probmotion.io.asf import AcclaimSkeleton, AcclaimText, read_asf
from probmotion.io.errors import shortened
from probmotion.motion.motion import Motion
from probmotion.validation import check_positive

__all__ = ["read_amc"]

_RATE = ":SAMPLES-PER-SECOND"


def read_amc(
    path: str | Path, skeleton_path: str | Path | None = None, fps: float = 120.0
) -> Motion:
    """Read a motion from an AMC file.

    Parameters
    ----------
    path : str or Path
        AMC file.
    skeleton_path : str or Path, optional
        ASF file of the skeleton. Default: the file in the same folder named after the motion or
        its subject (``02.asf`` for ``02_01.amc``).
    fps : float
        Frames per second, which files rarely declare. Most files of the CMU database have 120, some
        have 60. An error is raised if the file declares another rate.

    Returns
    -------
    motion : Motion
        Motion in metres, without rotations: sibling bones rotate independently, which joint
        rotations cannot express.

    Raises
    ------
    MotionFileError
        If a file is truncated, damaged or of another format.
    FileNotFoundError
        If the file or its skeleton does not exist.
    ValueError
        If ``fps`` is not above 0.
    """
    path = Path(path)
    check_positive("fps", fps)
    text = AcclaimText.of(path)
    _check_declarations(text, fps)
    body = read_asf(_beside(path) if skeleton_path is None else skeleton_path)
    positions = _world_positions(body, _frames(text, body))
    return Motion(positions, body.skeleton, fps, name=path.stem)


def _beside(path: Path) -> Path:
    """Return the ASF file that matches an AMC file by name."""
    stems = dict.fromkeys((path.stem, path.stem.rpartition("_")[0] or path.stem))
    candidates = [path.with_name(f"{stem}.asf") for stem in stems]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"{path}: expected the skeleton {' or '.join(map(str, candidates))}, got no such "
        "file; pass skeleton_path"
    )


def _check_declarations(text: AcclaimText, fps: float) -> None:
    """Check the format, unit and frame rate declared before the first frame."""
    declared = set()
    for line, words in text.lines:
        if not words[0].startswith(":"):
            break
        declared.add(words[0].upper())
        if words[0].upper() == _RATE and text.numbers(line, _RATE, words[1:], 1) != [fps]:
            text.fail(line, f"{_RATE}: expected fps={fps:g}, got {words[1]}")
    else:
        text.fail(text.length, "expected at least one frame, got the end of the file")
    for keyword in (":FULLY-SPECIFIED", ":DEGREES"):
        if keyword not in declared:
            text.fail(line, f"expected {keyword} before the first frame, got {shortened(words[0])}")


def _frames(text: AcclaimText, body: AcclaimSkeleton) -> list[dict[str, list[float]]]:
    """Return the channel values of every frame, by joint name."""
    names = body.skeleton.joint_names
    counts = {
        name: len(channels) for name, channels in zip(names, body.channels, strict=True) if channels
    }
    frames: list[dict[str, list[float]]] = []
    number = 0

    def check_last(line: int) -> None:
        missing = counts.keys() - frames[-1].keys() if frames else set()
        if missing:
            name = shortened(min(missing))
            text.fail(line, f"expected all moving bones in frame {number}, got none of {name}")

    for line, words in text.lines:
        name = words[0]
        if name.startswith(":") and not frames:
            continue
        if len(words) == 1 and name.isascii() and name.isdigit() and len(name) < 10:
            check_last(line)
            if frames and int(name) != number + 1:
                text.fail(line, f"expected frame {number + 1}, got {name}")
            number = int(name)
            frames.append({})
        elif not frames or name not in counts or name in frames[-1]:
            wanted = "each moving bone once per frame" if frames else "a frame number"
            text.fail(line, f"expected {wanted}, got {shortened(name)}")
        else:
            frames[-1][name] = text.numbers(line, shortened(name), words[1:], counts[name])
    check_last(text.length)
    return frames


def _world_positions(body: AcclaimSkeleton, frames: list[dict[str, list[float]]]) -> np.ndarray:
    """Return positions (L, J, 3), metres."""
    L, J = len(frames), body.skeleton.n_joints
    positions = np.zeros((L, J, 3))
    world = np.empty((J, L, 3, 3))
    for joint in body.skeleton.topological_order:
        name, channels = body.skeleton.joint_names[joint], body.channels[joint]
        values = np.array([frame.get(name, ()) for frame in frames], dtype=np.float64).T
        by_channel = dict(zip(channels, values, strict=True))
        C = body.axes[joint]
        world[joint] = C @ _rotations(by_channel, L) @ C.T
        parent = body.skeleton.parents[joint]
        if parent < 0:
            for axis, channel in enumerate(("TX", "TY", "TZ")):
                positions[:, joint, axis] = body.unit * by_channel.get(channel, 0.0)
        else:
            world[joint] = world[parent] @ world[joint]
            positions[:, joint] = positions[:, parent] + world[joint] @ body.offsets[joint]
    return positions


def _rotations(moved: dict[str, np.ndarray], frames: int) -> np.ndarray:
    """Return the channel rotations M (L, 3, 3) of one joint."""
    order = [channel[1] for channel in moved if channel.startswith("R")]
    order = [*order, *(axis for axis in "XYZ" if axis not in order)][::-1]
    zeros = np.zeros(frames)
    angles = [np.deg2rad(moved.get(f"R{axis}", zeros)) for axis in order]
    return np.asarray(euler_to_matrix(np.stack(angles, axis=-1), "".join(order)))

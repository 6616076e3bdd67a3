"""Summaries of files for ``probmotion show``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.cli.training_options import listed_clips
from probmotion.io.keypoints.tracks import KeypointFile
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.draws import MotionDraws

__all__ = ["Summary", "kind_of_network", "summarise"]


_MODEL = "model.safetensors"
_LOSSES = ("loss", "validation_loss")
_MOMENTS, _MOST_TRACKS = 6, 4  # in figures of keypoints
_MOST_ROOTS = 4  # named in summaries


@dataclass(frozen=True, eq=False)
class Summary:
    """Text summary of a file; n motions (n, L, J, 3), metres, or tracks, for figures."""

    text: str
    skeleton: Skeleton
    motions: np.ndarray
    label: str
    tracks: Sequence[KeypointTrack] = ()

    def draw(self, path: Path) -> None:
        """Write a figure of the motions or tracks."""
        from probmotion.plots.skeletons import draw_skeletons

        if self.tracks:
            _draw_tracks(self.tracks, path)
            return
        if not len(self.motions):
            raise ValueError("figure requires a file with motion or keypoints, got none")
        sided = bool(self.skeleton.mirrored_pairs)
        draw_skeletons(
            {self.label: self.motions},
            self.skeleton,
            path,
            moments=8 if len(self.motions) == 1 else 5,
            heading=np.pi / 3 if sided else None,
        )


def summarise(
    path: Path,
    fps: float | None = None,
    skeleton: str | None = None,
    image_size: tuple[float, float] | None = None,
    **conventions: Any,
) -> Summary:
    """Return a summary of a file of motion, keypoints or draws, or of a trained network.

    ``fps``, ``skeleton`` and ``image_size`` are arguments of
    :func:`~probmotion.io.keypoints.open_keypoints`, ``conventions`` those of
    :func:`~probmotion.load`.

    Raises
    ------
    MotionFileError
        If the type of the file is not supported, or the file is damaged.
    FileNotFoundError
        If the file does not exist.
    """
    if path.suffix == ".nc" and not _contains_positions(path):
        return _draw_summary(path, MotionDraws.load(path))
    if path.suffix == ".safetensors":
        return _checkpoint_summary(path)
    if (path / _MODEL).is_file():
        return _checkpoint_summary(path / _MODEL)
    if _contains_keypoints(path):
        from probmotion.io.keypoints.files import open_keypoints

        file = open_keypoints(path, fps, skeleton, image_size=image_size)
        return _track_summary(path, file)
    from probmotion.io.files import load

    return _motion_summary(path, load(path, **conventions))


def kind_of_network(path: Path) -> str:
    """Return the kind of the trained network in a file or the folder of a training run."""
    file = path / _MODEL if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(
            f"there is no network {file}; pass a file, the folder of a training run or the name of "
            "a shipped network"
        )
    return str(_header(file)["kind"])


def _contains_keypoints(path: Path) -> bool:
    if path.suffix == ".npz":
        from zipfile import BadZipFile, ZipFile

        try:
            with ZipFile(path) as archive:
                names = archive.namelist()
        except BadZipFile:
            return False
        return "keypoints.npy" in names and "positions.npy" not in names
    keypoints = (".json", ".csv", ".h5", ".hdf5", ".slp", ".nc")
    return path.suffix.lower() in keypoints or path.is_dir()


def _contains_positions(path: Path) -> bool:
    """Return whether a netCDF file contains keypoints, as those of movement."""
    from h5py import File, is_hdf5

    if not is_hdf5(path):
        return False
    with File(path, "r") as file:
        return "position" in file


def _motion_summary(path: Path, motion: Motion) -> Summary:
    heights = motion.positions[..., 1]
    root = motion.positions[:, motion.skeleton.roots[0]]
    travelled = np.linalg.norm(np.diff(root[:, [0, 2]], axis=0), axis=-1).sum()
    text = [
        f"{path}: a motion",
        _length(motion.frames, motion.fps),
        _joints(motion.skeleton),
        f"  height {heights.min():.2f} to {heights.max():.2f} m, root path {travelled:.2f} m",
        f"  local rotations: {'yes' if motion.rotations is not None else 'no'}",
    ]
    return Summary("\n".join(text), motion.skeleton, motion.positions[None], motion.name)


def _track_summary(path: Path, file: KeypointFile) -> Summary:
    tracks, skeleton = file.tracks, file.tracks[0].skeleton
    count = f"{len(tracks)} keypoint track{'s' if len(tracks) != 1 else ''}"
    text = [f"{path}: {file.format}, {count}"]
    for track in tracks:
        frames = f"  {track.frames} frame{'s' if track.frames != 1 else ''}, fps unknown"
        length = frames if file.fps is None else _length(track.frames, file.fps)
        missing = (track.confidence == 0).mean()
        text += [f"  {track.name}:", f"{length}, {missing:.0%} of keypoints missing"]
    known = [name for name in PRESETS if Skeleton.preset(name) == skeleton]
    text += [f"  skeleton {name}" for name in known] + [_joints(skeleton)]
    empty = np.empty((0, 1, skeleton.n_joints, 3))
    return Summary("\n".join(text), skeleton, empty, "", tracks)


def _draw_tracks(tracks: Sequence[KeypointTrack], path: Path) -> None:
    """Write a figure with a row of frames per track; missing keypoints are not drawn."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    from probmotion.plots.skeletons import joint_sides
    from probmotion.plots.style import INK, LEFT, PAGE, RIGHT, SIZE, finish_figure

    shown = [track for track in tracks if (track.confidence > 0).any()][:_MOST_TRACKS]
    if not shown:
        raise ValueError("figure requires at least one keypoint, got none")
    figure = Figure(figsize=(PAGE, 1.8 * len(shown)), layout="constrained")
    for part, track in zip(figure.subfigures(len(shown), squeeze=False)[:, 0], shown, strict=True):
        part.suptitle(track.name, size=SIZE, color=INK)
        seen, sides = track.confidence > 0, joint_sides(track.skeleton)
        colours = [{"left": LEFT, "right": RIGHT, "middle": INK}[side] for side in sides]
        present = np.flatnonzero(seen.any(axis=1))
        moments = min(len(present), _MOMENTS)
        chosen = present[np.linspace(0, len(present) - 1, moments).round().astype(int)]
        poses = [track.keypoints[frame, seen[frame]] for frame in chosen]
        half = 0.55 * max(float(np.ptp(pose, axis=0).max()) for pose in poses) + 1e-9
        row = part.subplots(1, moments, squeeze=False)[0]
        for axes, frame, pose in zip(row, chosen, poses, strict=True):
            x, y = (pose.min(axis=0) + pose.max(axis=0)) / 2
            axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half), aspect="equal")
            axes.set_axis_off()
            axes.set_title(f"frame {frame}", size=SIZE, color=INK)
            axes.scatter(*pose.T, s=4, c=np.array(colours)[seen[frame]], zorder=2)
            bones = [bone for bone in track.skeleton.bones if seen[frame, list(bone)].all()]
            lines = [track.keypoints[frame, list(bone)] for bone in bones]
            axes.add_collection(LineCollection(lines, colors=[colours[j] for j, _ in bones]))
    finish_figure(figure, path)


def _draw_summary(path: Path, draws: MotionDraws) -> Summary:
    attributes, sizes = draws.dataset.attrs, draws.dataset.sizes
    sampler = str(attributes["sampler"])
    evaluations = ", ".join(f"{n} {kind}" for kind, n in draws.counts.items()) or "not counted"
    text = [
        f"{path}: draws of {sampler}",
        f"  {sizes['chain']} x {sizes['draw']} (chains x draws), seed {attributes['seed']}, "
        f"{draws.seconds:.1f} s",
        _length(sizes["frame"], draws.fps),
        _joints(draws.skeleton),
        f"  evaluations: {evaluations}",
        f"  settings: {attributes['settings']}",
    ]
    return Summary("\n".join(text), draws.skeleton, draws.flat()[:4], sampler)


def _checkpoint_summary(path: Path) -> Summary:
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    header = _header(path)
    try:
        kind, card = header["kind"], header["settings"]
        # A denoiser stores joints and size in the settings of its prior.
        network = card["network"].get("prior", card["network"])
        skeleton = Skeleton(network["joint_names"], network["parents"])
        shape = ", ".join(f"{name} {value}" for name, value in network["size"].items())
        text = [
            f"{path}: a {kind} of {header['numbers']} parameters",
            f"  {shape}",
            _joints(skeleton),
            *_training_data(kind, card["network"]),
            _progress(card),
        ]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise _not_a_checkpoint(path) from error
    return Summary("\n".join(text), skeleton, np.empty((0, 1, skeleton.n_joints, 3)), "")


def _header(path: Path) -> dict[str, Any]:
    """Return the header of a checkpoint with its number of parameters as ``numbers``."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})["probmotion"])
            sizes = [np.prod(file.get_slice(name).get_shape()) for name in file.keys()]  # noqa: SIM118
        return {"kind": header["kind"], **header, "numbers": sum(map(int, sizes))}
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise _not_a_checkpoint(path) from error


def _not_a_checkpoint(path: Path) -> ValueError:
    from probmotion.io.errors import MotionFileError

    return MotionFileError(f"{path} is damaged or not a checkpoint of probmotion")


def _training_data(kind: str, network: dict[str, Any]) -> list[str]:
    """Return lines that describe the training data of a network."""
    if kind == "motion-dvae":
        data = network["data"]
        frames = f"  trained on {data['frames']} frames of {listed_clips(data['clips'])}"
        return [_windows(network), frames]
    if kind == "motion-denoiser":
        noise = network["noise"]
        return [
            _windows(network["prior"]),
            f"  trained on noisy joints of {listed_clips(network['clips'])}",
            f"  noise of {noise['least']:g} to {noise['most']:g} m, outliers in "
            f"{noise['outliers']:.0%} of windows, occlusion in {noise['hidden']:.0%}",
        ]
    data = network["data"]
    return [f"  trained on {data['tracks']} tracks of {', '.join(data['clips'])}"]


def _windows(network: dict[str, Any]) -> str:
    frames, fps = network["size"]["frames"], network["fps"]
    return f"  windows of {frames} frames at {fps:g} fps, {(frames - 1) / fps:.2f} s"


def _progress(card: dict[str, Any]) -> str:
    """Return a line with training steps, batch size, time and last losses."""
    last, training = card["history"][-1] if card["history"] else {}, card["training"]
    losses = "".join(f", {key.replace('_', ' ')} {last[key]:.4f}" for key in _LOSSES if key in last)
    return (
        f"  step {card['step']} of {training['steps']}, batches of {training['batch']}, "
        f"{card['seconds']:.0f} s{losses}"
    )


def _length(frames: int, fps: float) -> str:
    return f"  {frames} frames at {fps:g} fps, {(frames - 1) / fps:.2f} s"


def _joints(skeleton: Skeleton) -> str:
    roots = [skeleton.joint_names[root] for root in skeleton.roots]
    more = f" and {len(roots) - _MOST_ROOTS} others" if len(roots) > _MOST_ROOTS else ""
    return (
        f"  {skeleton.n_joints} joints, rooted at {', '.join(roots[:_MOST_ROOTS])}{more}, "
        f"{len(skeleton.mirrored_pairs)} left-right pairs"
    )

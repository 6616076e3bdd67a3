"""Recovery of a held-out motion clip with a prior fitted to other clips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from probmotion.data.cmu_clips import cmu_clip
from probmotion.models.mixture.gaussian_mixture import GaussianMixtureMotion
from probmotion.motion.motion import Motion
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, simulated
from probmotion.problems import observations
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_positive

__all__ = ["CLIP_PROBLEMS", "clips_problem"]

_WINDOWS = 1000  # approximate number of windows to which a prior is fitted
_HELD_OUT = "cmu_02_02"


def clips_problem(
    motions: Sequence[Motion],
    *,
    frames: int = 30,
    fps: float | None = None,
    rank: int = 10,
    styles: int = 3,
    observe: str = "monocular",
    noise: float = 0.02,
    held_out: int | str = -1,
    seed: int = 0,
    name: str = "clips",
) -> Problem:
    """Return the problem of recovering a held-out clip from keypoints of one camera.

    The prior is fitted to about 1000 evenly spaced windows of the other clips, on the joints common
    to all clips. The truth is the centred middle window of the held-out clip.

    Parameters
    ----------
    motions : sequence of Motion
        At least two clips with any skeletons.
    frames : int
        Number of frames L of the motions.
    fps : float, optional
        Frame rate to which clips are resampled; required if their rates differ.
    rank : int
        Latent dimensions per style.
    styles : int
        Number of styles into which the windows are clustered.
    observe : str
        Observations of the held-out window: a name of
        :data:`~probmotion.problems.observations.OBSERVATIONS`; ``"none"`` for generation.
    noise : float
        Standard deviation of a keypoint, metres.
    held_out : int or str
        Index or name of the held-out clip.
    seed : int
        Seed of the clustering and the keypoint noise.
    name : str
        Name of the problem in tables.

    Raises
    ------
    ValueError
        If there are too few or too short clips, frame rates differ without ``fps``, ``held_out`` is
        unknown, or a style has too few windows for ``rank``.
    """
    check_count("frames", frames, least=2)
    check_positive("noise", noise)
    if len(motions) < 2:
        raise ValueError(
            "motions must contain at least 2 clips, one to hold out and the rest to fit the prior, "
            f"got {len(motions)}"
        )
    _check_distinct(motions)
    index = _index(motions, held_out)
    with one_thread():
        clips = _harmonised(motions, fps)
        target = clips.pop(index)
        if target.frames < frames:
            raise ValueError(f"held_out must be a clip of at least frames={frames}, got {target}")
        truth = target.window((target.frames - frames) // 2, frames).centred()
        likelihood = observations.observe(truth, observe, noise, seed)
        long = [clip for clip in clips if clip.frames >= frames]
        if not long:
            raise ValueError(
                f"motions must contain a clip of at least frames={frames} besides the held-out "
                f"one, got at most {max(clip.frames for clip in clips)}"
            )
        starts = sum(clip.frames - frames + 1 for clip in long)
        prior = GaussianMixtureMotion.fit(
            long,
            frames,
            rank=rank,
            styles=styles,
            stride=min(frames, max(1, starts // _WINDOWS)),
            seed=seed,
        )
    problem = Problem(
        name,
        _description(long, len(clips) - len(long), target, frames, observe, noise),
        MotionPosterior(prior, likelihood),
        None if likelihood is None else truth.positions,
    )
    return simulated(problem)


def _check_distinct(motions: Sequence[Motion]) -> None:
    """Raise ``ValueError`` for duplicate clips, which would leak the held-out motion."""
    seen: dict[bytes, Motion] = {}
    for motion in motions:
        key = motion.positions.tobytes()
        if key in seen:
            raise ValueError(
                f"motions must be distinct, got {motion} twice (as {seen[key].name or 'unnamed'} "
                f"and {motion.name or 'unnamed'})"
            )
        seen[key] = motion


def _index(motions: Sequence[Motion], held_out: int | str) -> int:
    if isinstance(held_out, str):
        names = [motion.name for motion in motions]
        if names.count(held_out) != 1:
            known = ", ".join(names)
            raise ValueError(f"held_out must name exactly one of {known}, got {held_out!r}")
        return names.index(held_out)
    if not -len(motions) <= held_out < len(motions):
        raise ValueError(f"held_out must be an index into the {len(motions)} clips, got {held_out}")
    return held_out % len(motions)


def _harmonised(motions: Sequence[Motion], fps: float | None) -> list[Motion]:
    """Return the clips with a common frame rate and skeleton."""
    from probmotion.motion.retargeting import common_skeleton

    if fps is not None:
        motions = [motion.resample(fps) for motion in motions]
    if len(rates := sorted({motion.fps for motion in motions})) > 1:
        raise ValueError(
            f"motions must have one frame rate, got {', '.join(f'{rate:.6g}' for rate in rates)} "
            "frames per second; set fps= to resample them"
        )
    skeleton = common_skeleton([motion.skeleton for motion in motions])
    return [motion.retarget(skeleton) for motion in motions]


def _description(
    fitted: Sequence[Motion], too_short: int, held_out: Motion, frames: int, how: str, noise: float
) -> str:
    clips = f"{len(fitted)} clip{'s' * (len(fitted) != 1)}"
    left_out = f" ({too_short} shorter than {frames} frames left out)" if too_short else ""
    prior = f"prior fitted to {clips} of {fitted[0].skeleton.n_joints} joints{left_out}"
    name = held_out.name or "the one held out"
    if how == "none":
        return f"{prior}, without {name}; no observations"
    return f"{prior}; {how} keypoints (σ {100 * noise:g} cm) of {name}, which was held out"


def _cmu_problem(name: str, description: str, observe: str) -> Problem:
    """Return a problem on ten clips of CMU subject 02."""
    clips = [cmu_clip(f"cmu_02_{trial:02}") for trial in range(1, 11)]
    problem = clips_problem(clips, observe=observe, held_out=_HELD_OUT, name=name)
    return replace(problem, description=description)


CLIP_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = {
    name: (description, partial(_cmu_problem, name, description, observe))
    for name, description, observe in (
        ("cmu", f"a second of CMU's subject 02, {_HELD_OUT} held out: generation", "none"),
        ("cmu-monocular", f"{_HELD_OUT}, 2D keypoints of one camera (σ 2 cm)", "monocular"),
    )
}
"""Description and factory of each problem, by name."""

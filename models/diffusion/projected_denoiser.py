"""2D denoiser for a 3D prior, trained on projections of its motions.

With this denoiser, samplers such as `mas` apply to priors without a 2D denoiser of their own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from probmotion import seeds
from probmotion.data.projections import DetectorNoise, Filming, project_clips
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee, usual_training
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import Motion
from probmotion.posteriors.protocols import MotionPrior, Samplable
from probmotion.validation import check_count

__all__ = ["denoiser_of"]

_HELD_OUT = 10  # One in this many motions is held out.
_Size = Literal["tiny", "small", "paper"]


def denoiser_of(
    prior: MotionPrior,
    out: str | Path,
    *,
    size: _Size = "small",
    motions: int = 400,
    views: int = 16,
    filming: Filming | None = None,
    training: TrainingSettings | None = None,
    seed: int = 0,
    progress: bool = True,
) -> MotionDiffusion:
    """Return a 2D motion diffusion model trained on projections of a prior's motions.

    Motions drawn from the prior are projected without detection errors by cameras around them; a
    tenth of the motions is held out. Repeat the call to resume an interrupted run.

    Parameters
    ----------
    prior : MotionPrior
        Prior with a ``sample`` method.
    out : str or Path
        Folder of the training run.
    size : {"tiny", "small", "paper"}
        Size of the network, for motions of the prior's length.
    motions : int
        Number of motions, at least 2.
    views : int
        Number of cameras per motion.
    filming : Filming, optional
        Camera placement; by default that of :class:`~probmotion.data.projections.Filming`.
    training : TrainingSettings, optional
        Training settings; :func:`usual_training` of the size by default.
    seed : int
        Seed of motions, cameras and initial weights.
    progress : bool
        Whether to show a progress bar.

    Raises
    ------
    ValueError
        If the prior has no ``sample`` method, a number or size is invalid, or ``out``
        contains another run.
    Diverged
        If training diverges.
    """
    if not isinstance(prior, Samplable):
        raise ValueError(f"prior must have a sample method, got {type(prior).__name__}")
    check_count("motions", motions, least=2)
    if size not in get_args(_Size):
        raise ValueError(f"size must be one of {', '.join(get_args(_Size))}, got {size!r}")
    drawn = prior.sample(seeds.generator(seed, "filmed motions"), motions)
    clips = [
        Motion(positions, prior.skeleton, prior.fps, name=f"drawn-{number}")
        for number, positions in enumerate(drawn)
    ]
    # Detection errors are not part of the prior.
    noise = DetectorNoise.none()
    tracks = project_clips(clips, views=views, seed=seed, filming=filming, noise=noise)
    held_out = views * max(1, motions // _HELD_OUT)
    settings = getattr(DiffusionSettings, size)(prior.frames)
    trainee = DiffusionTrainee(tracks[held_out:], tracks[:held_out], settings, seed=seed)
    result = train(trainee, training or usual_training(size), out, progress=progress)
    return MotionDiffusion.load(result.model)

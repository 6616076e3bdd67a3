"""A 2D denoiser of a prior that has none, learnt from pictures of its motions.

With it samplers that need one, as `mas` does, run on what the prior knows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from probmotion import seeds
from probmotion.data.projections import DetectorNoise, Filming, project_clips
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee, usual_training
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.posteriors.protocols import MotionPrior, Samplable
from probmotion.validation import check_count

__all__ = ["denoiser_of"]

_HELD_OUT = 10


def denoiser_of(
    prior: MotionPrior,
    out: str | Path,
    *,
    size: Literal["tiny", "small", "paper"] = "small",
    motions: int = 400,
    views: int = 16,
    filming: Filming | None = None,
    training: TrainingSettings | None = None,
    seed: int = 0,
    progress: bool = True,
) -> MotionDiffusion:
    """Return a 2D motion diffusion model that has learnt a prior's motions from their pictures.

    Motions are drawn from the prior, filmed from all around without a detector's errors, and a
    tenth of them is held out. The same call goes on where an earlier one was stopped.

    Parameters
    ----------
    prior : MotionPrior
        One that can be sampled.
    out : str or Path
        Folder of the training run.
    size : {"tiny", "small", "paper"}
        Of the network, for motions as long as the prior's.
    motions : int
        How many are drawn, at least 2.
    views : int
        Cameras per motion.
    filming : Filming, optional
        Where cameras stand; the defaults of :class:`~probmotion.data.projections.Filming`.
    training : TrainingSettings, optional
        How it is trained; as is usual for the size by default.
    seed : int
        Of motions, cameras and first weights.
    progress : bool
        Show a bar.

    Raises
    ------
    ValueError
        If the prior cannot be sampled, a number is out of range, the size is unknown, or ``out``
        holds another run.
    Diverged
        If training does.
    """
    if not isinstance(prior, Samplable):
        raise ValueError(f"prior must be one that can be sampled, got {type(prior).__name__}")
    check_count("motions", motions, least=2)
    sizes = {
        "tiny": DiffusionSettings.tiny,
        "small": DiffusionSettings.small,
        "paper": DiffusionSettings.paper,
    }
    if size not in sizes:
        raise ValueError(f"size must be one of {', '.join(sizes)}, got {size!r}")
    usual = usual_training(size)
    tracks = _filmed(prior, motions, views, filming, seed)
    held_out = views * max(1, motions // _HELD_OUT)
    trainee = DiffusionTrainee(
        tracks[held_out:], tracks[:held_out], sizes[size](prior.frames), seed=seed
    )
    result = train(trainee, usual if training is None else training, out, progress=progress)
    return MotionDiffusion.load(result.model)


def _filmed(
    prior: MotionPrior, motions: int, views: int, filming: Filming | None, seed: int
) -> list[KeypointTrack]:
    """Return the tracks of drawn motions, those of a motion side by side."""
    assert isinstance(prior, Samplable)
    drawn = prior.sample(seeds.generator(seed, "filmed motions"), motions)
    clips = [
        Motion(positions, prior.skeleton, prior.fps, name=f"drawn-{number}")
        for number, positions in enumerate(drawn)
    ]
    # A denoiser of the prior: it should not learn a detector's errors with it.
    return project_clips(clips, views=views, seed=seed, filming=filming, noise=DetectorNoise.none())

"""Train the motion VAEs and write the weights and model cards that the package ships.

    python notebooks/ship_motion_vae.py walk-vae --runs runs
    python notebooks/ship_motion_vae.py animal-vae --runs runs

A stopped run continues; a finished one is not repeated. Networks are written to
``models/weights`` in half precision, with the evaluator and the features of held-out views. Clips
are read from ``--data``, by default ../shared/data beside the repository, and filmed; their 3D
positions are used only to count how often the correct view is chosen.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from ship_walk2d import write_features

from probmotion.data.projections import Filming, centre_motion
from probmotion.data.synthetic.animals import ANIMAL_SKELETON, animal_clips
from probmotion.data.synthetic.walks import walk_clips
from probmotion.data.tracks.learning import certain, film_clips
from probmotion.files import written_whole
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
from probmotion.models.training.checkpoints import WEIGHTS, load_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee, PoseTrainee, usual_motion_vae_training
from probmotion.models.vae.view_hypotheses import HypothesisAccuracy, evaluate_hypotheses
from probmotion.motion.distances import windows
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton

ROOT = Path(__file__).parents[1]
FPS = 10.0


@dataclass(frozen=True)
class Kind:
    """One prior: its skeleton, clips by part, and their origin."""

    about: str
    skeleton: Skeleton
    clips: Callable[[Path], dict[str, list[Motion]]]
    views: Mapping[str, int]
    """Cameras around a clip of a data set whose name begins so."""
    kl: float
    """Weight of KL: of people the tenfold of the published one generates better; of animals, whose
    motion is smaller in metres, it leaves nothing in the code."""
    steps: int
    """Of the second phase."""
    provenance: str


KINDS = {
    "walk-vae": Kind(
        "People who walk",
        Skeleton.preset("person14"),
        walk_clips,
        {"": 64},
        0.01,
        1500,
        "humanoid3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng. cmu_*: "
        "mocap.cs.cmu.edu, free for research and commercial use; the database was created with "
        "funding from NSF EIA-0196217.",
    ),
    "animal-vae": Kind(
        "Four-legged animals that walk, trot, pace, canter and spin",
        ANIMAL_SKELETON,
        animal_clips,
        {"quadruped": 16, "dog3d": 128},
        0.001,
        2500,
        "dog3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng; they look like dog motion "
        "capture that its authors offer for non-commercial use, and should be treated so in doubt. "
        "quadruped-*: made by this project.",
    ),
}


def main() -> None:
    """Train what is missing; write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", choices=KINDS)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    asked = parser.parse_args()
    kind, folder = KINDS[asked.name], asked.runs / asked.name
    clips = kind.clips(asked.data)
    tracks = filmed(kind, clips)
    prior = trained(kind, tracks, folder)
    prior.save(WEIGHTS / f"{asked.name}.safetensors", half=True)
    # As it will be loaded: half-precision weights.
    prior = MotionVAE.load(asked.name)
    evaluator = trained_evaluator(tracks, prior.frames, folder / "evaluator")
    evaluator.save(WEIGHTS / f"{asked.name}-evaluator.safetensors", half=True)
    evaluator = TrackEvaluator.load(f"{asked.name}-evaluator")
    write_features(asked.name, evaluator, prior, clips)
    text = card(asked.name, kind, prior, folder, clips)
    with written_whole(WEIGHTS / f"{asked.name}.md") as path:
        path.write_text(text, encoding="utf-8")
    print(text)


def filmed(kind: Kind, clips: dict[str, list[Motion]]) -> dict[str, list[KeypointTrack]]:
    """Return prepared 2D tracks by part."""
    tracks: dict[str, list[KeypointTrack]] = {}
    for part in ("train", "validation"):
        tracks[part] = []
        for start, views in kind.views.items():
            if some := of_kind(clips[part], start, kind):
                tracks[part] += certain(film_clips(some, kind.skeleton, FPS, views=views).tracks)
    return tracks


def trained(kind: Kind, tracks: dict[str, list[KeypointTrack]], folder: Path) -> MotionVAE:
    """Return the prior, trained in a folder."""
    size = replace(MotionVAESettings.small(), kl=kind.kl)
    body = ArticulatedBody(kind.skeleton, estimate_rest_pose(tracks["train"]))
    given = tracks["train"], tracks["validation"], size, body
    poses, vae = usual_motion_vae_training("small")
    first = PoseTrainee(*given, distance=Filming().distance)
    train(first, poses, folder / "poses")
    second = MotionVAETrainee(*given, first.learnt(folder / "poses"), distance=Filming().distance)
    train(second, replace(vae, steps=kind.steps), folder / "vae")
    return MotionVAE.load(folder / "vae")


def trained_evaluator(
    tracks: dict[str, list[KeypointTrack]], frames: int, folder: Path
) -> TrackEvaluator:
    """Return the evaluator, trained in a folder on the same tracks."""
    trainee = EvaluatorTrainee(
        tracks["train"], tracks["validation"], EvaluatorSettings.small(frames)
    )
    train(trainee, TrainingSettings(steps=3000, learning_rate=1e-3), folder)
    return TrackEvaluator.load(folder)


def judged_views(
    kind: Kind, prior: MotionVAE, clips: dict[str, list[Motion]]
) -> dict[str, HypothesisAccuracy]:
    """Return how often the correct view is chosen, by part and data set."""
    found = {}
    for part in ("train", "test"):
        for start in kind.views:
            of = f"{part}, {start}" if start else part
            some = of_kind(clips[part], start, kind)
            found[of] = evaluate_hypotheses(
                prior.model.pose, prior.settings, prior.body, some, fps=FPS
            )
    return found


def of_kind(clips: list[Motion], start: str, kind: Kind) -> list[Motion]:
    """Return the clips whose names start with a prefix, unless a longer prefix applies."""
    longer = [other for other in kind.views if other.startswith(start) and other != start]
    return [
        clip
        for clip in clips
        if clip.name.startswith(start) and not any(clip.name.startswith(one) for one in longer)
    ]


def pace_of_draws(prior: MotionVAE, clips: dict[str, list[Motion]]) -> tuple[float, float]:
    """Return the mean speed of draws relative to held-out motion, and the proportion of slow draws.

    A draw is slow if it is slower than 99 of 100 held-out sequences.
    """
    motions = [
        centre_motion(clip.retarget(prior.skeleton).resample(prior.fps)) for clip in clips["test"]
    ]
    real = np.concatenate([windows(motion.positions, prior.frames) for motion in motions])
    drawn = prior.sample(np.random.default_rng(0), 1000)
    ours, theirs = (
        np.linalg.norm(np.diff(some, axis=1), axis=-1).mean(axis=(1, 2)) for some in (drawn, real)
    )
    slow = float((ours < np.quantile(theirs, 0.01)).mean())
    return float(ours.mean() / theirs.mean()), slow


def card(
    name: str, kind: Kind, prior: MotionVAE, folder: Path, clips: dict[str, list[Motion]]
) -> str:
    """Return the model card."""
    network, size = prior.card["network"], prior.settings
    poses = load_checkpoint(folder / "poses", PoseTrainee.kind).settings
    rows = []
    for phase, kept in (("poses", poses), ("VAE", prior.card)):
        last = kept["history"][-1]
        rows.append(
            f"| {phase} | {kept['step']} | {kept['training']['batch']} | {kept['seconds']:.0f} | "
            f"{last['loss']:.3f} | {last['validation_loss']:.3f} |"
        )
    views = [
        f"| {part} | {100 * one.right:.1f} % | {100 * one.depth_right:.1f} % | "
        f"{1000 * one.error:.0f} mm |"
        for part, one in judged_views(kind, prior, clips).items()
    ]
    pace, slow = pace_of_draws(prior, clips)
    weights = (WEIGHTS / f"{name}.safetensors").stat().st_size / 1e6
    return f"""# {name}

{kind.about}: a motion VAE learnt from 2D tracks alone. Motions of {size.frames} frames of
{prior.skeleton.n_joints} joints at {prior.fps:g} frames per second; z of {size.latent} numbers,
λ_KL = {size.kl:g}; {weights:.1f} MB.

- **Data**: {network["data"]["tracks"]} tracks of {network["data"]["frames"]} frames, filmed
  {network["distance"]:g} m away from random sides, of
  {listed(network["data"]["clips"])};
  tracks are mirrored every other time. The loss is watched on
  {listed(network["validation_data"]["clips"])}.
- **Provenance**: {kind.provenance}
- **Not for**: other skeletons or frame rates; motions unlike those named. The rigid pose is no
  part of the latent code: draws stay in place and look ahead.

| phase | steps | batch | seconds | loss | validation loss |
|---|---|---|---|---|---|
{chr(10).join(rows)}

Seconds are of training steps on one thread of a shared CPU; no GPU was used.

The view hypothesis that is chosen, in 1000 sequences of clips whose 3D is known (right: nearest to
the truth, or a fifth farther; depth: nearer to the truth than its mirror image in depth; by chance
a quarter and a half):

| clips | right | depth right | joints' distance from the truth |
|---|---|---|---|
{chr(10).join(views)}

Draws move at {pace:.2f} of the mean speed of held-out motion; {100 * slow:.0f} % of 1000 draws are
slower than 99 of 100 held-out sequences.

Command: `python notebooks/ship_motion_vae.py {name} --runs runs`.
"""


def listed(names: Sequence[str]) -> str:
    """Return names in a row; synthetic clips are counted by kind."""
    kinds = Counter(re.sub(r"-\d+$", "", name) for name in names)
    return ", ".join(f"{kind} ({n} clips)" if n > 1 else kind for kind, n in kinds.items())


if __name__ == "__main__":
    main()

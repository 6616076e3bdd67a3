"""Train walk-vae and animal-vae and write their weights and model cards.

    python notebooks/ship_motion_vae.py walk-vae --runs runs
    python notebooks/ship_motion_vae.py animal-vae --runs runs
    python notebooks/ship_motion_vae.py animal-vae --runs runs --third    (codes and encoder only)

Run the command again to resume a stopped run. Networks are written to ``models/weights`` in half
precision, with the evaluator and the features of held-out views. Clips are read from ``--data``, by
default ../shared/data beside the repository, and projected to 2D; their 3D positions are used only
to evaluate the selection of view hypotheses.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from ship_diffusion import write_features

from probmotion.data.projections import Filming, centre_motion
from probmotion.data.synthetic.animals import ANIMAL_SKELETON, VARIED_TRUNKS, animal_clips
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
from probmotion.models.vae.code_fitting import with_learnt_codes
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
    """Skeleton, clips and training settings of one prior."""

    about: str
    skeleton: Skeleton
    clips: Callable[[Path], dict[str, list[Motion]]]
    views: Mapping[str, int]
    """Number of cameras per clip, by the prefix of clip names."""
    kl: float
    """Weight of the KL divergence. Ten times the published weight improves generation of people; for
    animals, whose motion is smaller in metres, the latent code would collapse."""
    steps: int
    """Number of steps of the second phase."""
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
        partial(animal_clips, trunks=VARIED_TRUNKS),
        {"quadruped": 16, "dog3d": 128},
        0.001,
        2500,
        "dog3d_*: xbpeng/DeepMimic, MIT licence, © 2018 Xue Bin Peng; they resemble dog motion "
        "capture that its authors offer for non-commercial use only, which may apply here too. "
        "quadruped-*: synthetic clips of this project, with trunks of varied lengths.",
    ),
}


def main() -> None:
    """Train all networks unless finished, and write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", choices=KINDS, help="Name of the prior.")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="Folder of training runs.")
    data = ROOT.parent / "shared" / "data"
    parser.add_argument("--data", type=Path, default=data, help="Folder of the clips.")
    text = "Learn only the codes and the encoder of the shipped networks again; keep the card."
    parser.add_argument("--third", action="store_true", help=text)
    options = parser.parse_args()
    kind, folder = KINDS[options.name], options.runs / options.name
    if options.third:
        prior = with_third_phase(options.name, kind, options.data, folder)
        prior.save(WEIGHTS / f"{options.name}.safetensors", half=True)
        return
    clips = kind.clips(options.data)
    tracks = projected_tracks(kind, clips)
    prior = trained(kind, tracks, folder)
    prior.save(WEIGHTS / f"{options.name}.safetensors", half=True)
    # The card describes the shipped half-precision weights.
    prior = MotionVAE.load(options.name)
    evaluator = trained_evaluator(tracks, prior.frames, folder / "evaluator")
    evaluator.save(WEIGHTS / f"{options.name}-evaluator.safetensors", half=True)
    evaluator = TrackEvaluator.load(f"{options.name}-evaluator")
    write_features(options.name, evaluator, prior, clips)
    text = card(options.name, kind, prior, folder, clips)
    with written_whole(WEIGHTS / f"{options.name}.md") as path:
        path.write_text(text, encoding="utf-8")
    print(text)


def projected_tracks(kind: Kind, clips: dict[str, list[Motion]]) -> dict[str, list[KeypointTrack]]:
    """Return prepared 2D tracks by part."""
    tracks: dict[str, list[KeypointTrack]] = {}
    for part in ("train", "validation"):
        tracks[part] = []
        for start, views in kind.views.items():
            if some := clips_of(clips[part], start, kind):
                tracks[part] += certain(film_clips(some, kind.skeleton, FPS, views=views).tracks)
    return tracks


def trained(kind: Kind, tracks: dict[str, list[KeypointTrack]], folder: Path) -> MotionVAE:
    """Return the prior, trained in a folder."""
    size = replace(MotionVAESettings.small(), kl=kind.kl)
    body = ArticulatedBody(kind.skeleton, estimate_rest_pose(tracks["train"]))
    given = tracks["train"], tracks["validation"], size, body
    poses, vae, encoder = usual_motion_vae_training("small")
    first = PoseTrainee(*given, distance=Filming().distance)
    train(first, poses, folder / "poses")
    second = MotionVAETrainee(*given, first.learnt(folder / "poses"), distance=Filming().distance)
    train(second, replace(vae, steps=kind.steps), folder / "vae")
    prior = MotionVAE.load(folder / "vae", codes=None)
    return with_learnt_codes(second, prior, encoder, folder / "encoder")


def with_third_phase(name: str, kind: Kind, data: Path, folder: Path) -> MotionVAE:
    """Return the shipped networks with codes and encoder learnt again, from an eighth of the views.

    They do not need more views, which are those of the same clips.
    """
    fewer = {start: views // 8 for start, views in kind.views.items()}
    tracks = projected_tracks(replace(kind, views=fewer), kind.clips(data))
    prior = MotionVAE.load(name)
    given = tracks["train"], tracks["validation"], prior.settings, prior.body, prior.model.pose
    trainee = MotionVAETrainee(*given, distance=Filming().distance)
    settings = usual_motion_vae_training("small")[2]
    return with_learnt_codes(trainee, prior, settings, folder / "encoder")


def trained_evaluator(
    tracks: dict[str, list[KeypointTrack]], frames: int, folder: Path
) -> TrackEvaluator:
    """Return the evaluator, trained in a folder on the same tracks."""
    trainee = EvaluatorTrainee(
        tracks["train"], tracks["validation"], EvaluatorSettings.small(frames)
    )
    train(trainee, TrainingSettings(steps=3000, learning_rate=1e-3), folder)
    return TrackEvaluator.load(folder)


def view_accuracy(
    kind: Kind, prior: MotionVAE, clips: dict[str, list[Motion]]
) -> dict[str, HypothesisAccuracy]:
    """Return the accuracy of view selection, by part and data set."""
    accuracies = {}
    for part in ("train", "test"):
        for start in kind.views:
            label = f"{part}, {start}" if start else part
            some = clips_of(clips[part], start, kind)
            accuracies[label] = evaluate_hypotheses(
                prior.model.pose, prior.settings, prior.body, some, fps=FPS
            )
    return accuracies


def clips_of(clips: list[Motion], start: str, kind: Kind) -> list[Motion]:
    """Return the clips whose names start with a prefix, unless a longer prefix applies."""
    longer = [other for other in kind.views if other.startswith(start) and other != start]
    return [
        clip
        for clip in clips
        if clip.name.startswith(start) and not any(clip.name.startswith(one) for one in longer)
    ]


def relative_speed(prior: MotionVAE, clips: dict[str, list[Motion]]) -> tuple[float, float]:
    """Return the mean speed of draws relative to held-out motion, and the proportion of slow draws.

    A draw is slow if it is slower than 99 % of held-out sequences.
    """
    motions = [
        centre_motion(clip.retarget(prior.skeleton).resample(prior.fps)) for clip in clips["test"]
    ]
    real = np.concatenate([windows(motion.positions, prior.frames) for motion in motions])
    drawn = prior.sample(np.random.default_rng(0), 1000)
    draw_speeds, real_speeds = (
        np.linalg.norm(np.diff(some, axis=1), axis=-1).mean(axis=(1, 2)) for some in (drawn, real)
    )
    slow = float((draw_speeds < np.quantile(real_speeds, 0.01)).mean())
    return float(draw_speeds.mean() / real_speeds.mean()), slow


def card(
    name: str, kind: Kind, prior: MotionVAE, folder: Path, clips: dict[str, list[Motion]]
) -> str:
    """Return the model card."""
    network, size = prior.card["network"], prior.settings
    poses = load_checkpoint(folder / "poses", PoseTrainee.kind).settings
    rows = []
    for phase, record in (("poses", poses), ("VAE", prior.card)):
        last = record["history"][-1]
        rows.append(
            f"| {phase} | {record['step']} | {record['training']['batch']} | "
            f"{record['seconds']:.0f} | {last['loss']:.3f} | {last['validation_loss']:.3f} |"
        )
    views = [
        f"| {part} | {100 * one.right:.1f} % | {100 * one.depth_right:.1f} % | "
        f"{1000 * one.error:.0f} mm |"
        for part, one in view_accuracy(kind, prior, clips).items()
    ]
    speed, slow = relative_speed(prior, clips)
    weights = (WEIGHTS / f"{name}.safetensors").stat().st_size / 1e6
    return f"""# {name}

{kind.about}: a motion variational autoencoder (VAE) learnt from 2D tracks alone. Motions have
{size.frames} frames of {prior.skeleton.n_joints} joints at {prior.fps:g} frames per second; z has {size.latent}
dimensions; λ_KL = {size.kl:g}; {weights:.1f} MB.

- **Data**: {network["data"]["tracks"]} tracks of {network["data"]["frames"]} frames,
  projected from random sides at a distance of {network["distance"]:g} m and mirrored with probability 1/2.
  Training clips: {clip_list(network["data"]["clips"])}.
  Validation clips: {clip_list(network["validation_data"]["clips"])}.
  Test clips: {clip_list([clip.name for clip in clips["test"]])}.
- **Provenance**: {kind.provenance}
- **Not for**: other skeletons or frame rates; motions unlike the training clips. The rigid pose is
  not part of the latent code: draws stay at one position and face forward.

| phase | steps | batch | seconds | loss | validation loss |
|---|---|---|---|---|---|
{chr(10).join(rows)}

Seconds: duration of training on one thread of a shared CPU; no GPU was used.

Accuracy of the selected view hypothesis in 1000 sequences with known 3D motion (correct view: error
at most 1.2 times the smallest, 25 % by chance; correct depth: closer to the truth than the mirror
image in depth, 50 % by chance):

| clips | correct view | correct depth | mean joint error |
|---|---|---|---|
{chr(10).join(views)}

Draws are from a mixture of {len(prior.codes.weights)} Gaussians fitted to codes of training windows. The mean
speed of 1000 draws is {speed:.2f} times that of held-out motion; {100 * slow:.0f} % of draws are slower than
99 % of held-out sequences.

Command: `python notebooks/ship_motion_vae.py {name} --runs runs`.
"""


def clip_list(names: Sequence[str]) -> str:
    """Return names as text, with the numbers of synthetic clips by kind."""
    kinds = Counter(re.sub(r"-\d+$", "", name) for name in names)
    return ", ".join(f"{kind} ({n} clips)" if n > 1 else kind for kind, n in kinds.items())


if __name__ == "__main__":
    main()

"""Ablations of the motion VAE (Sun et al. 2024) and comparison of generation with MAS and SDS.

    python notebooks/ablations/motion_vae.py --out vae
    python notebooks/ablations/motion_vae.py --quick --out quick    (synthetic walks, tiny networks)

``--parts`` selects views (accuracy of view hypotheses), table (tables 6, 7 and 8 of the paper),
data (tables 3 and 4: more clips, then smoothness) and generation. All variants are trained here
on the same tracks, with ``--steps`` steps in the second phase; networks in ``--out/networks`` are
reused. Draws are stored in ``--out/comparisons``. Clips are read from ``--data``, by default
../shared/data of the repository; 3D clips are projected to 2D for training and are the truth in
the evaluation.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from parts import CLIPS, arguments, run_parts

from probmotion import seeds
from probmotion.comparison import compare
from probmotion.data.projections import Filming, centre_motion
from probmotion.data.synthetic.walks import synthetic_walks, walk_clips
from probmotion.data.tracks.learning import certain, film_clips
from probmotion.metrics.filming import film_motions
from probmotion.metrics.keypoints import (
    image_extent,
    percentage_of_correct_keypoints,
    velocity_error,
)
from probmotion.metrics.motion_chamfer import motion_chamfer_distance
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.training.trainer import train
from probmotion.models.vae.losses import (
    best_hypothesis,
    hypothesis_losses,
    project_to_image,
    weighted_sum,
)
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee, PoseTrainee, usual_motion_vae_training
from probmotion.models.vae.view_hypotheses import evaluate_hypotheses
from probmotion.motion.distances import mirrored_fraction, nearest_distances, windows
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems import load_problem
from probmotion.samplers import ExactSampler, MultiViewAncestral, ScoreDistillation
from probmotion.samplers.diffusion.noise_levels import Cosine

FPS = 10.0
FRAMES = 10
PERSON = Skeleton.preset("person14")
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "final": {},
    "20 frames": {"frames": 20},
    "50 frames": {"frames": 50},
    "no spatial transformer": {"spatial": False},
    "KL 0.01": {"kl": 0.01},
    "KL 0.0001": {"kl": 0.0001},
    "no smoothness": {"smoothness": 0.0},
}
# Every n-th clip is used for training, and the variant: the paper compares MagicPony data, added
# videos, and added smoothness.
DATA: Mapping[str, tuple[int, str]] = {
    "a quarter of the clips": (4, "no smoothness"),
    "all clips": (1, "no smoothness"),
    "all clips, smoothness": (1, "final"),
}
OF_POSES = ("smoothness", "hypotheses")
SEEDS = 3


@dataclass(frozen=True)
class Study:
    """Data and size of the study; every ``every``-th training clip is used."""

    out: Path
    data: Path
    quick: bool
    steps: int | None
    draws: int
    seed: int = 0
    every: int = 1

    @cached_property
    def clips(self) -> dict[str, list[Motion]]:
        """3D clips by part."""
        if not self.quick:
            return walk_clips(self.data)
        walks = synthetic_walks(18, PERSON)
        return {"train": walks[:12], "validation": walks[12:15], "test": walks[15:]}

    @cached_property
    def tracks(self) -> dict[str, list[KeypointTrack]]:
        """Prepared 2D tracks by part."""
        views = dict.fromkeys(("train", "validation"), 4 if self.quick else 64)
        clips_by_part = self.clips | {"train": self.clips["train"][:: self.every]}
        return {
            part: certain(
                film_clips(clips, PERSON, FPS, views=views.get(part, 16), seed=self.seed).tracks
            )
            for part, clips in clips_by_part.items()
        }

    @cached_property
    def body(self) -> ArticulatedBody:
        """The articulated body estimated from the tracks."""
        return ArticulatedBody(PERSON, estimate_rest_pose(self.tracks["train"]))

    def size(self, changes: Mapping[str, Any]) -> MotionVAESettings:
        """Return the network size of a variant."""
        defaults = MotionVAESettings.tiny() if self.quick else MotionVAESettings.small()
        return replace(defaults, **changes)

    def poses(self, changes: Mapping[str, Any]) -> PoseNetwork:
        """Return the network of the first phase, shared by variants with the same loss."""
        used = {name: value for name, value in changes.items() if name in OF_POSES}
        trainee = self._trainee(PoseTrainee, self.size(used))
        folder = self.out / "networks" / " ".join(["poses", *map(str, used.values())])
        self._train(trainee, 0, folder)
        return trainee.learnt(folder)

    def variant(self, name: str) -> MotionVAE:
        """Train a variant and return its prior."""
        changes = VARIANTS[name]
        trainee = self._trainee(MotionVAETrainee, self.size(changes), self.poses(changes))
        folder = self.out / "networks" / name
        self._train(trainee, 1, folder)
        return MotionVAE.load(folder, codes=None)

    def _trainee(self, kind: Any, size: MotionVAESettings, *more: Any) -> Any:
        # Use training tracks if all validation tracks are too short; no setting depends on them.
        long = [track for track in self.tracks["validation"] if track.frames >= size.frames]
        return kind(
            self.tracks["train"],
            long or self.tracks["train"],
            size,
            self.body,
            *more,
            distance=Filming().distance,
            seed=self.seed,
        )

    def _train(self, trainee: Any, phase: int, folder: Path) -> None:
        settings = usual_motion_vae_training("tiny" if self.quick else "small")[phase]
        if phase == 1 and self.steps is not None:
            settings = replace(settings, steps=self.steps)
        train(trainee, settings, folder, progress=not self.quick)

    def real_windows(self, part: str, frames: int, fps: float = FPS) -> np.ndarray:
        """Return all root-centred windows of the 3D clips of a part, (N, frames, J, 3)."""
        motions = [centre_motion(c.retarget(PERSON).resample(fps)) for c in self.clips[part]]
        return np.concatenate(
            [windows(motion.positions, frames) for motion in motions if motion.frames >= frames]
        )

    def real_views(self, part: str, n: int) -> np.ndarray:
        """Return new 2D views of clips without detector noise, (n, frames, J, 2)."""
        rng = seeds.generator(self.seed, "real views", part)
        motions = self.real_windows(part, FRAMES)
        return film_motions(motions[rng.integers(0, len(motions), n)], rng)


def views(study: Study) -> pd.DataFrame:
    """Return the accuracy of view selection by number of view hypotheses."""
    rows = []
    n = 100 if study.quick else 1000
    for hypotheses in (1, 2, 4):
        changes = {} if hypotheses == 4 else {"hypotheses": hypotheses}
        network, size = study.poses(changes), study.size(changes)
        for part in ("train", "test"):
            result = evaluate_hypotheses(network, size, study.body, study.clips[part], n=n, fps=FPS)
            rows.append(
                {
                    "hypotheses": hypotheses,
                    "clips": part,
                    "right": result.right,
                    "depth_right": result.depth_right,
                    "mpjpe": 1000 * result.error,
                    "least_mpjpe": 1000 * result.least_error,
                }
            )
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def reconstructed(
    study: Study, changes: Mapping[str, Any], prior: MotionVAE | None = None
) -> dict[str, float]:
    """Return PCK and velocity error in % on held-out tracks; without ``prior``, of poses only."""
    poses, size = study.poses(changes), study.size(changes)
    tracks = study.tracks["test"]
    keypoints = np.concatenate([segments_of(track.keypoints, size.frames) for track in tracks])
    visible = (
        np.concatenate([segments_of(track.confidence, size.frames) for track in tracks]) >= 0.3
    )
    detected = visible.any(axis=(1, 2))
    keypoints, visible = keypoints[detected], visible[detected]
    shown = np.where(visible[..., None], keypoints, 0.0)
    observed = torch.as_tensor(shown, dtype=torch.float32)
    weight = torch.as_tensor(visible, dtype=torch.float32)
    rest = torch.as_tensor(study.body.rest_positions, dtype=torch.float32)
    distance = Filming().distance
    with torch.no_grad():
        hypotheses = poses.eval()(observed, weight, rest)
        terms = hypothesis_losses(study.body, hypotheses, observed, weight, distance)
        best = best_hypothesis(hypotheses, weighted_sum(terms, size))
        turns = best.turns
        if prior is not None:
            turns = prior.model.vae.decode(prior.model.vae.encode(observed, weight, rest)[0])
        translation = torch.nn.functional.pad(best.translation, (0, 1))
        joints = study.body.positions(turns, best.rotation, translation, best.log_lengths)
        projected = project_to_image(joints, distance).numpy()
    sizes = image_extent(shown, visible)
    return {
        "pck": percentage_of_correct_keypoints(projected, shown, sizes, visible=visible),
        "pck_0.05": percentage_of_correct_keypoints(
            projected, shown, sizes, visible=visible, threshold=0.05
        ),
        "velocity_error": 100 * velocity_error(projected, shown, visible),
    }


def segments_of(values: np.ndarray, frames: int) -> np.ndarray:
    """Return consecutive segments of an array (L, …), as (n, frames, …)."""
    n = len(values) // frames
    return values[: n * frames].reshape(n, frames, *values.shape[1:])


def generated(study: Study, motions: np.ndarray, seed: int) -> dict[str, float]:
    """Return the motion chamfer distance between 2D views of motions and real views, cm²."""
    rng = seeds.generator(study.seed, "film", seed)
    views_2d = film_motions(motions, rng)
    row = {}
    for part in ("test", "train"):
        distance = motion_chamfer_distance(views_2d, study.real_views(part, study.draws))
        row[f"mcd_{part}"] = 1e4 * distance.mean
        row[f"mcd_{part}_of_generated"] = 1e4 * distance.of_generated
    return row


def metrics_of(study: Study, name: str) -> dict[str, float]:
    """Return reconstruction and generation metrics of a variant."""
    started = time.perf_counter()
    prior = study.variant(name)
    row = {"seconds": time.perf_counter() - started} | reconstructed(study, VARIANTS[name], prior)
    repeats = pd.DataFrame(
        [
            generated(study, prior.sample(seeds.generator(seed, "draws"), study.draws), seed)
            for seed in range(SEEDS)
        ]
    )
    return row | repeats.mean().to_dict() | {"mcd_test_sd": repeats["mcd_test"].std()}


def table(study: Study) -> pd.DataFrame:
    """Return the metrics of every variant."""
    rows: list[dict[str, Any]] = []
    for name in VARIANTS:
        rows.append({"variant": name} | metrics_of(study, name))
        print(rows[-1], flush=True)
    rows.append({"variant": "no motion VAE"} | reconstructed(study, {}))
    rng = seeds.generator(study.seed, "real draws")
    motions = study.real_windows("train", FRAMES)
    real = motions[rng.integers(0, len(motions), study.draws)]
    rows.append({"variant": "real motion that was learnt from"} | generated(study, real, 0))
    for row in rows[-2:]:
        print(row, flush=True)
    return pd.DataFrame(rows)


def data(study: Study) -> pd.DataFrame:
    """Return the metrics of poses and of the VAE by amount of data and smoothness."""
    rows: list[dict[str, Any]] = []
    for name, (every, variant) in DATA.items():
        subset = study if every == 1 else replace(study, out=study.out / name, every=every)
        of_poses = reconstructed(subset, VARIANTS[variant])
        row = {f"poses_{metric}": value for metric, value in of_poses.items()}
        rows.append({"learnt from": name} | row | metrics_of(subset, variant))
        print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def generation(study: Study) -> pd.DataFrame:
    """Return the generation metrics of the VAE, and of MAS and SDS with the prior walk2d."""
    other = load_problem("walk2d")
    longer = other.posterior
    per_motion = longer.frames // round(longer.fps / FPS) // FRAMES
    # A run has at least ten draws.
    n = max(10, study.draws // 10)
    motion_vae = (
        MotionPosterior(study.variant("final")) if study.quick else load_problem("walk-vae")
    )
    iterations = 50 if study.quick else 1000
    mas = (
        MultiViewAncestral(steps=10, levels=Cosine(trained_steps=100))
        if study.quick
        else MultiViewAncestral()
    )
    grids: tuple[tuple[str, Problem | MotionPosterior, dict[str, Sampler], int], ...] = (
        ("motion-vae", motion_vae, {"motion VAE": ExactSampler()}, n * per_motion),
        (
            "walk2d",
            other,
            {"MAS": mas, "SDS": ScoreDistillation(iterations=iterations)},
            n,
        ),
    )
    rows = []
    for name, source, samplers, draws in grids:
        comparison = compare(
            {name: source},
            samplers,
            draws=draws,
            chains=1,
            out=study.out / "comparisons" / name,
            workers=0,
            progress=not study.quick,
        )
        for run in comparison.results:
            row: dict[str, Any] = {"way": run.sampler}
            if run.failure is None:
                motions = sequences(comparison.draws(run.problem, run.sampler))
                row |= {"sequences": len(motions), "seconds": run.metrics["seconds"]}
                row |= distances_to_real(study, motions)
            else:
                row["failed"] = str(run.failure)
            rows.append(row)
            print(row, flush=True)
    rng = seeds.generator(study.seed, "real draws")
    real = study.real_windows("train", FRAMES)
    motions = real[rng.integers(0, len(real), n * per_motion)]
    row = {"way": "real motion that was learnt from", "sequences": len(motions)}
    rows.append(row | distances_to_real(study, motions))
    print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def sequences(draws: MotionDraws) -> np.ndarray:
    """Return draws as sequences at the frame rate of the study, (n, FRAMES, J, 3)."""
    thinned = draws.flat()[:, :: round(draws.fps / FPS)]
    return np.concatenate([segments_of(motion, FRAMES) for motion in thinned])


def distances_to_real(study: Study, motions: np.ndarray) -> dict[str, float]:
    """Return distances of root-centred motions and their views to real ones."""
    centred = motions - motions[:, :, :1]
    row = generated(study, centred, 0)
    truth = {part: study.real_windows(part, FRAMES)[::3] for part in ("test", "train")}
    for part, real in truth.items():
        error = nearest_distances(centred, real)
        row |= {f"to_{part}_mm": 1000 * error.of_draws, f"of_{part}_mm": 1000 * error.of_real}
    return row | {"mirrored": mirrored_fraction(centred, truth["test"])}


PARTS = {"views": views, "table": table, "data": data, "generation": generation}


def main() -> None:
    """Run the selected parts; each writes a table to ``--out``."""
    parser = arguments(__doc__, PARTS)
    parser.add_argument("--data", type=Path, default=CLIPS, help="Folder of the clips.")
    parser.add_argument("--steps", type=int, help="Training steps of the second phase.")
    parser.add_argument("--draws", type=int, help="Generated sequences; default: 1400.")
    parser.add_argument(
        "--seed", type=int, default=0, help="Seed of tracks and training; default: 0."
    )
    options = parser.parse_args()
    draws = options.draws or (60 if options.quick else 1400)
    given = options.out, options.data, options.quick, options.steps, draws, options.seed
    study = Study(*given)
    run_parts(study, PARTS, options.parts)


if __name__ == "__main__":
    main()

"""Evaluation of MAS on motion capture: tables 2 and 3 of Kapon et al. (2024), and errors in 3D.

    python notebooks/ablations/mas.py --out mas
    python notebooks/ablations/mas.py --quick --out quick    (synthetic walks, tiny networks, 1 min)

``--parts`` selects table, sets, tracks, conditioned, times and exact; ``--prior`` the prior, walk2d
or motion2d, whose networks are part of the package. The lifter is trained here on the same tracks.
Draws are stored in ``--out/comparisons``, views of the 2D model and lifted motions in
``--out/motions``; run the same command again to resume an interrupted study. Clips are read from
``--data``, by default ../shared/data of the repository.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from parts import CLIPS, arguments, run_parts
from scipy.special import logit

from probmotion import seeds
from probmotion.comparison import Comparison, compare
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.comparison.results.run_results import RunResult
from probmotion.data.person_clips import moving_clips
from probmotion.data.projections import DetectorNoise, Filming, centre_motion, project_clips
from probmotion.data.synthetic.walks import synthetic_walks, walk_clips
from probmotion.data.tracks.learning import LearningTracks, film_clips, film_windows, split_tracks
from probmotion.files import written_whole
from probmotion.geometry.cameras import Cameras
from probmotion.io.predictions import read_predictions
from probmotion.metrics.generation import COLLAPSED_BELOW, GenerationReference
from probmotion.metrics.measures import measure
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.lifter import LifterSettings, PoseLifter
from probmotion.models.evaluation.lifter_training import LifterTrainee
from probmotion.models.evaluation.pose_flow import FlowSettings, PoseFlow
from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.models.unseen_depth import motion_prior_from_tracks
from probmotion.motion.distances import mirrored_fraction, nearest_distances, windows
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.generation import draw_generation
from probmotion.plots.skeletons import draw_skeletons
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import MotionPrior
from probmotion.posteriors.sampling import Sampler
from probmotion.problems import load_problem
from probmotion.samplers import (
    ExactSampler,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
    ScoreDistillation,
    SplitGibbs,
)
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.noise_levels import Karras, LogSNR

SEED = 0
SETS = {"2D model": 3, "MAS": 1, "mvpc": 1}  # numbers of sets of draws for the model card
FPS = 20.0
OBSERVED_NOISE = 0.02  # of the keypoints of conditioned draws, metres
PERSON = Skeleton.preset("person14")
SHOWN = {
    "fid": "FID, held-out clips",
    "fid_learnt": "FID, learnt clips",
    "recall_learnt": "Recall, learnt clips",
    "precision_learnt": "Precision, learnt clips",
    "to_real_mm": "3D: to held-out, mm",
    "of_real_mm": "3D: held-out to draws, mm",
}


@dataclass(frozen=True)
class Study:
    """Data, networks and size of the study."""

    out: Path
    data: Path
    quick: bool
    draws: int
    iterations: int
    repeats: int
    steps: int
    device: str
    workers: int
    name: str
    predictions: Path | None = None

    @cached_property
    def clips(self) -> dict[str, list[Motion]]:
        """3D clips by part; only 2D views of the training clips are used."""
        if self.quick:
            walks = synthetic_walks(24, seconds=4)
            return {"train": walks[:16], "validation": walks[16:18], "test": walks[18:]}
        return walk_clips(self.data) if self.name == "walk2d" else moving_clips(self.data)

    @cached_property
    def tracks(self) -> LearningTracks:
        """Detected 2D tracks of the clips, by part."""
        all_clips = [clip for clips in self.clips.values() for clip in clips]
        filmed = film_clips(all_clips, PERSON, FPS, views=8 if self.quick else 64)
        names = {part: [clip.name for clip in clips] for part, clips in self.clips.items()}
        return split_tracks(filmed.tracks, validation=names["validation"], test=names["test"])

    def views(self, part: str, n: int, seed: int = 1) -> np.ndarray:
        """Return random 2D windows of a part, (n, L, J, 2)."""
        return film_windows(self.clips[part], PERSON, FPS, self.frames, n, seed=SEED + seed)

    def motions(self, part: str) -> np.ndarray:
        """Return all 3D windows of a part and their mirror images, (n, L, J, 3), metres.

        Mirror images are included because models are also trained on mirrored views.
        """
        clips = [
            centre_motion(clip.retarget(PERSON).resample(FPS)).positions
            for clip in self.clips[part]
        ]
        # Runs of motion2d are shorter than its motions.
        long = [clip for clip in clips if len(clip) >= self.frames]
        straight = np.concatenate([windows(clip, self.frames) for clip in long])
        mirrored = straight[:, :, list(PERSON.mirrored_order)] * np.array([-1.0, 1.0, 1.0])
        return np.concatenate([straight, mirrored])

    @cached_property
    def prior(self) -> MotionDiffusion:
        """The 2D motion diffusion model."""
        if not self.quick:
            return MotionDiffusion.load(self.name, device=self.device)
        size = DiffusionSettings.tiny(20)
        trainee = DiffusionTrainee(self.tracks.train, self.tracks.validation, size)
        settings = TrainingSettings(steps=600, batch=32, learning_rate=2e-3, ema=0.99)
        return MotionDiffusion.load(self.trained("diffusion", trainee, settings))

    @cached_property
    def reference(self) -> GenerationReference:
        """Held-out real 2D motion and the evaluator network for its features."""
        if not self.quick:
            reference = load_problem(self.name).generation
            assert reference is not None
            return reference
        trainee = EvaluatorTrainee(
            self.tracks.train, self.tracks.validation, EvaluatorSettings.tiny(20)
        )
        settings = TrainingSettings(steps=300, batch=32, learning_rate=2e-3, ema=0.99)
        evaluator = TrackEvaluator.load(self.trained("evaluator", trainee, settings))
        held_out, learnt = (evaluator.features(self.views(part, 200)) for part in ("test", "train"))
        return GenerationReference(evaluator, held_out, learnt)

    @cached_property
    def problem(self) -> Problem:
        """The problem that samplers draw from."""
        return Problem(
            "walks",
            "people who move, diffusion prior learnt from 2D tracks alone: generation",
            MotionPosterior(self.prior),
            generation=replace(self.reference, held_out_views=self.views("test", 400)),
        )

    @property
    def frames(self) -> int:
        """Number of frames L of a motion."""
        return self.prior.frames

    def trained(self, name: str, trainee: object, settings: TrainingSettings) -> Path:
        """Train a network, or resume its training; return the checkpoint."""
        return train(trainee, settings, self.out / name, progress=False).model

    def once(
        self, name: str, made_from: object, make: Callable[[], np.ndarray]
    ) -> tuple[np.ndarray, float]:
        """Return motions or views and the seconds of their computation; load them if stored."""
        path = self.out / "motions" / f"{name}.npz"
        origin = fingerprint(made_from)
        if not path.exists():
            start = time.perf_counter()
            made = make()
            seconds = time.perf_counter() - start
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path) as unfinished, open(unfinished, "wb") as file:
                np.savez_compressed(
                    file, made=made.astype(np.float32), seconds=seconds, origin=origin
                )
            print(f"{name}: {len(made)} in {seconds:.0f} s", flush=True)
        with np.load(path) as archive:
            if str(archive["origin"]) != origin:
                raise SystemExit(
                    f"{path} must have the same settings and weights; use another --out"
                )
            return archive["made"].astype(np.float64), float(archive["seconds"])

    def compared(
        self,
        part: str,
        problems: Mapping[str, Problem | MotionPosterior],
        samplers: Mapping[str, Sampler],
        draws: int | None = None,
    ) -> Comparison:
        """Return the comparison of a part; stored runs are reused."""
        return compare(
            problems,
            samplers,
            draws=draws or self.draws,
            chains=1,
            out=self.out / "comparisons" / part,
            workers=self.workers,
            progress=not self.quick,
        )


ACCURATE = replace(
    MultiViewPredictorCorrector.learnt(), steps=100, corrector_steps=2, corrector_size=0.4
)


def samplers(iterations: int) -> dict[str, Sampler]:
    """Return the samplers of table 2 and additional variants."""
    return {
        "MAS": MultiViewAncestral(perspective=True),
        "MAS, orthographic": MultiViewAncestral(),
        "MAS, 2 views": MultiViewAncestral(n_views=2, perspective=True),
        "MAS, no 3D noise": MultiViewAncestral(perspective=True, shared_noise=False),
        "mvpc": MultiViewPredictorCorrector.learnt(),
        "mvpc, accurate": ACCURATE,
        "SDS, uniform": ScoreDistillation(iterations=iterations),
        "SDS, annealed": ScoreDistillation(iterations=iterations, levels="annealed"),
    }


def table(study: Study) -> pd.DataFrame:
    """Return tables 2 and 3: metrics of 2D views, of side views and of 3D motions."""
    posterior = study.problem.posterior
    real = study.motions("test")
    rows: list[dict[str, object]] = []

    def add(
        name: str, motions: np.ndarray | None, views: np.ndarray | None, seconds: float
    ) -> None:
        rows.append(score(study, name, motions, views, real, seconds))
        print(rows[-1], flush=True)

    for name, motions, views in true_motions(study):
        add(name, motions, views, math.nan)
    views, seconds = study.once(
        "2D model",
        [Ancestral2D(), study.prior, study.draws],
        lambda: Ancestral2D().sample_views(posterior, draws=study.draws, seed=SEED, progress=False),
    )
    add("2D model", None, views, seconds / study.draws)
    drawn = {}
    comparison = study.compared("table", {"walks": study.problem}, samplers(study.iterations))
    for run in comparison.results:
        rows.append(score_run(study, run.sampler, comparison, run, real))
        print(rows[-1], flush=True)
        if run.failure is None:
            drawn[run.sampler] = comparison.draws(run.problem, run.sampler).flat()
    lifted = study.views("train", study.draws)
    with written_whole(study.out / "to_lift.npz") as path, open(path, "wb") as file:
        np.savez_compressed(file, keypoints=lifted, fps=FPS, joint_names=PERSON.joint_names)
    for name, lifter in lifters(study).items():
        motions, seconds = study.once(
            name, [lifter, lifted], lambda lifter=lifter: lifter.lift(lifted)
        )
        drawn[name] = motions
        add(name, motions, None, seconds / study.draws)
    draw_skeletons(
        {"real, held out": real[:: max(1, len(real) // 4)], **drawn},
        PERSON,
        study.out / "draws.png",
        heading=math.pi / 3,
    )
    table = pd.DataFrame(rows)
    draw_generation(table, SHOWN, study.out / "table.png", logarithmic=["fid", "fid_learnt"])
    return table


def true_motions(study: Study) -> list[tuple[str, np.ndarray | None, np.ndarray | None]]:
    """Return names, 3D motions and 2D views of real motion."""
    # Ten times as many windows as draws, so that each repeat has different ones.
    views = {part: study.views(part, 10 * study.draws, seed=3) for part in ("test", "train")}
    rng = seeds.generator(SEED, "truth")
    shown = study.motions("train")
    shown = shown[rng.choice(len(shown), study.draws)]
    # Clips have one heading, draws have random headings.
    rotated = [
        Motion(clip, PERSON, FPS).turned(rng.uniform(0, 2 * math.pi)).positions for clip in shown
    ]
    return [
        ("held-out clips, 2D", None, views["test"]),
        ("truth, 2D", None, views["train"]),
        ("truth, 3D", np.stack(rotated), None),
    ]


def sets(study: Study) -> pd.DataFrame:
    """Return the metrics of sets of draws of the 2D model, MAS and mvpc, for the model card."""
    posterior, real = study.problem.posterior, study.motions("test")
    rows = [
        score(study, name, motions, views, real, math.nan)
        for name, motions, views in true_motions(study)
    ]
    options = {"draws": study.draws, "progress": False}
    for name, count in SETS.items():
        for seed in range(count):
            start = time.perf_counter()
            motions, views = None, None
            if name == "2D model":
                views = Ancestral2D().sample_views(posterior, seed=seed, **options)
            else:
                sampler = samplers(study.iterations)[name]
                motions = sampler.sample(posterior, chains=1, seed=seed, **options).flat()
            seconds = (time.perf_counter() - start) / study.draws
            rows.append(score(study, name, motions, views, real, seconds))
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def score(
    study: Study,
    name: str,
    motions: np.ndarray | None,
    views: np.ndarray | None,
    real: np.ndarray,
    seconds: float,
) -> dict[str, object]:
    """Return one row of the table; side-view and 3D metrics require ``motions``."""
    row: dict[str, object] = {"name": name, "seconds": seconds}
    # Each repeat uses a random half of the draws, so that ± includes the sampling error.
    settings = {"seed": SEED, "samples": study.draws // 2, "repeats": study.repeats}
    scores = {}
    if motions is None:
        assert views is not None
        row["speed"] = smooth_speed(views)
        scores[""] = study.reference.score_views(views, **settings)
        scores["_learnt"] = study.reference.of_learnt().score_views(views, **settings)
    else:
        scores[""] = study.reference.score_motions(motions, **settings)
        scores["_side"] = study.reference.score_motions(motions, **settings, angles="side")
        scores["_learnt"] = study.reference.of_learnt().score_motions(motions, **settings)
        scores["_learnt_side"] = study.reference.of_learnt().score_motions(
            motions, **settings, angles="side"
        )
        distances = nearest_distances(motions, real)
        row |= {
            "to_real_mm": 1000 * distances.of_draws,
            "of_real_mm": 1000 * distances.of_real,
            "mirrored": mirrored_fraction(motions, real),
            "bones_mm": 1000 * bone_changes(motions),
        }
    for suffix, metrics in scores.items():
        for metric, (mean, sd) in metrics.items():
            row |= {f"{metric}{suffix}": mean, f"{metric}{suffix}_sd": sd}
    row["collapsed"] = row["recall"] < COLLAPSED_BELOW
    return row


def smooth_speed(views: np.ndarray) -> float:
    """Return the mean speed of joints, m/s, in means over five frames, which remove most noise."""
    smooth = np.mean([views[:, k : views.shape[1] - 4 + k] for k in range(5)], axis=0)
    return float(np.linalg.norm(np.diff(smooth, axis=1), axis=-1).mean() * FPS)


def score_run(
    study: Study, name: str, comparison: Comparison, run: RunResult, real: np.ndarray
) -> dict[str, object]:
    """Return the row of a run of the comparison, or the reason for its failure."""
    if run.failure is not None:
        return {"name": name, "failed": str(run.failure)}
    motions = comparison.draws(run.problem, run.sampler).flat()
    return score(study, name, motions, None, real, run.metrics["seconds"] / study.draws)


def bone_changes(motions: np.ndarray) -> float:
    """Return the temporal standard deviation of bone lengths, mean over bones and motions."""
    ends, starts = np.array(PERSON.bones).T
    lengths = np.linalg.norm(motions[:, :, ends] - motions[:, :, starts], axis=-1)
    return float(lengths.std(axis=1).mean())


@dataclass(frozen=True, eq=False)
class Predictions:
    """Motions predicted from ``to_lift.npz`` by an external lifter."""

    motions: np.ndarray

    def lift(self, views: np.ndarray) -> np.ndarray:
        """Return the lifted motions."""
        if len(self.motions) != len(views):
            raise SystemExit(
                f"predictions must contain the {len(views)} motions of to_lift.npz, "
                f"got {len(self.motions)}"
            )
        return self.motions


class Flat:
    """Negative control: lifter that sets the depth of every joint to that of the root."""

    def lift(self, views: np.ndarray) -> np.ndarray:
        """Return the lifted motions."""
        camera = Cameras.ring(1, elevation=math.pi / 16)
        return views @ camera.rotation[0, :2]


def lifters(study: Study) -> Mapping[str, PoseLifter | Predictions | Flat]:
    """Return the lifters of 2D views, (n, L, J, 2) → (n, L, J, 3)."""
    flow_trainee = PoseFlowTrainee(
        study.tracks.train,
        study.tracks.validation,
        FlowSettings.tiny() if study.quick else FlowSettings.small(),
    )
    steps = study.steps // 10 if study.quick else study.steps
    settings = TrainingSettings(steps=steps, batch=256, learning_rate=1e-3)
    flow = PoseFlow.load(study.trained("flow", flow_trainee, settings))
    trainee = LifterTrainee(
        study.tracks.train,
        study.tracks.validation,
        flow,
        LifterSettings.tiny() if study.quick else LifterSettings.small(),
    )
    lifter = PoseLifter.load(study.trained("lifter", trainee, settings))
    named: dict[str, PoseLifter | Predictions | Flat] = {"lifter": lifter, "lifter, flat": Flat()}
    if study.predictions is not None:
        motions = read_predictions(study.predictions, PERSON, frames=study.frames, fps=FPS)
        named[study.predictions.stem] = Predictions(motions)
    return named


def track_prior(study: Study, components: int) -> SpectralMixtureMotion:
    """Return the spectral mixture learnt by EM from the 2D tracks of training."""
    filming = Filming()
    return motion_prior_from_tracks(
        study.tracks.train,
        study.frames,
        components=components,
        elevations=(filming.elevation - filming.tilt, filming.elevation + filming.tilt),
        distance=filming.distance,
    )


def tracks(study: Study) -> pd.DataFrame:
    """Return the metrics of draws of spectral mixtures learnt by EM from the same 2D tracks."""
    real = study.motions("test")
    rows = []
    for components in (1, 8):
        start = time.perf_counter()
        prior = track_prior(study, components)
        fitted = time.perf_counter()
        drawn = prior.sample(seeds.generator(SEED, "tracks"), study.draws)
        seconds = (time.perf_counter() - fitted) / study.draws
        name = f"spectral mixture, K = {components}"
        rows.append(score(study, name, drawn, None, real, seconds))
        rows[-1]["fit_seconds"] = fitted - start
        print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def conditioned(study: Study) -> pd.DataFrame:
    """Return the errors of motions given keypoints of one camera, of held-out clips."""
    clips, rng = study.motions("test"), seeds.generator(SEED, "observed")
    chosen = rng.choice(len(clips), 4 if study.quick else 6, replace=False)
    truths = {f"sequence-{number}": clips[row] for number, row in enumerate(chosen)}
    azimuths = rng.uniform(0, 2 * math.pi, len(chosen))
    observed = {
        name: Keypoints2D.observe(
            Motion(truth, PERSON, FPS),
            Cameras.around([azimuths[number]], [study.prior.view_elevation]),
            noise=OBSERVED_NOISE,
            seed=number,
        )
        for number, (name, truth) in enumerate(truths.items())
    }
    network: dict[str, Sampler] = {
        "MAS": MultiViewAncestral(),
        "mvpc": MultiViewPredictorCorrector.learnt(),
        "split-gibbs": SplitGibbs(),
    }
    methods: dict[str, tuple[Callable[[], MotionPrior], dict[str, Sampler]]] = {
        "network": (lambda: study.prior, network),
        "spectral": (lambda: track_prior(study, components=8), {"exact": ExactSampler()}),
    }
    rows = []
    for kind, (make_prior, samplers) in methods.items():
        prior = make_prior()
        posteriors = {name: MotionPosterior(prior, seen) for name, seen in observed.items()}
        comparison = study.compared(f"conditioned-{kind}", posteriors, samplers, draws=10)
        for sampler in samplers:
            runs = [run for run in comparison.results if run.sampler == sampler]
            failures = [str(run.failure) for run in runs if run.failure is not None]
            row: dict[str, object] = {"prior": kind, "sampler": sampler, "failed": len(failures)}
            if not failures:
                errors = pd.DataFrame(
                    errors_of(comparison.draws(run.problem, sampler).flat(), truths[run.problem])
                    for run in runs
                )
                row |= dict(errors.mean()) | dict(errors.sem().add_suffix("_se"))
            rows.append(row)
            print(row, flush=True)
    return pd.DataFrame(rows)


def errors_of(draws: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return joint errors of the mean and of draws, mm, and the mean's error over its prediction.

    The prediction is the standard deviation of the draws; above 1, draws are overconfident.
    """
    error = draws.mean(axis=0) - truth
    predicted = np.sqrt(draws.var(axis=0, ddof=1).mean() * (1 + 1 / len(draws)))
    return {
        "mean_mm": 1000 * float(np.linalg.norm(error, axis=-1).mean()),
        "draws_mm": 1000 * float(np.linalg.norm(draws - truth, axis=-1).mean()),
        "error_over_predicted": float(np.sqrt((error**2).mean()) / predicted),
    }


def times(study: Study) -> pd.DataFrame:
    """Return errors of denoised views between trained levels: at fractional or nearest times."""
    views = study.views("test", 100)[:, None]
    prior, camera = study.prior, Cameras.around([0.0], [study.prior.view_elevation])
    clean, trained = views / prior.scale, prior.settings.schedule.alpha_bar[1:]
    rows = []
    for levels in (Karras(smallest=0.026), LogSNR(smallest=0.026)):
        difference = np.zeros(len(views))
        error = np.zeros(len(views))
        schedule = levels.schedule(50)
        for number, alpha_bar in enumerate(schedule.alpha_bar[1:]):
            noise = seeds.generator(SEED, f"times/{number}").standard_normal(clean.shape)
            noisy = math.sqrt(alpha_bar) * clean + math.sqrt(1 - alpha_bar) * noise
            near = trained[abs(logit(trained) - logit(alpha_bar)).argmin()]
            # The network at the nearest trained level sees a signal of that level's strength.
            moved = noisy * math.sqrt(near / alpha_bar)
            each = [
                np.linalg.norm(prior.denoise(x, at, camera) - clean, axis=-1).mean(axis=(1, 2, 3))
                for x, at in ((noisy, alpha_bar), (moved, near))
            ]
            error += each[0] / schedule.steps
            difference += (each[1] - each[0]) / schedule.steps
        millimetres = 1000 * prior.scale
        rows.append(
            {
                "levels": levels.kind,
                "error_mm": millimetres * error.mean(),
                "nearest_minus_fractional_mm": millimetres * difference.mean(),
                "nearest_minus_fractional_se": millimetres * difference.std() / len(views) ** 0.5,
            }
        )
    return pd.DataFrame(rows)


def exact(study: Study) -> pd.DataFrame:
    """Return the errors of samplers with an exact denoiser and with a network, on ``gait``.

    The network is trained on views of prior draws. Metrics compare with exact draws.
    """
    problem = load_problem("gait")
    exact_prior = problem.posterior.prior
    n = 400 if study.quick else 4000
    drawn = exact_prior.sample(seeds.generator(SEED, "pictures"), n)
    clips = [
        Motion(motion, exact_prior.skeleton, exact_prior.fps, name=f"gait-{number}")
        for number, motion in enumerate(drawn)
    ]
    # Use the projection of the exact denoiser: orthographic, one elevation, centred on average.
    filming = Filming(tilt=0.0, perspective=False, centre="sequence")
    tracks = project_clips(clips, views=4, filming=filming, noise=DetectorNoise.none())
    n_validation = len(tracks) // 10
    size = DiffusionSettings.tiny(30) if study.quick else DiffusionSettings.small(30)
    plain = replace(Augmentation.none(), shortest=1.0)
    trainee = DiffusionTrainee(
        tracks[n_validation:], tracks[:n_validation], size, augmentation=plain
    )
    settings = TrainingSettings(steps=study.steps // (10 if study.quick else 1), learning_rate=1e-3)
    learnt = MotionDiffusion.load(study.trained("gait", trainee, settings))
    comparison = study.compared(
        "exact",
        {"exact": problem, "network": MotionPosterior(learnt)},
        {
            "mas": MultiViewAncestral(),
            "mvpc": MultiViewPredictorCorrector.learnt(),
            "mvpc, accurate": ACCURATE,
        },
    )
    metrics = (
        "swd_ratio",
        "variance_ratio",
        "mean_error_sd",
        "off_manifold_ratio",
        "mode_proportions_tv",
        "precision",
        "recall",
    )
    rows = []
    # Rows are sorted by sampler.
    for run in sorted(comparison.results, key=lambda run: run.sampler):
        row: dict[str, object] = {"sampler": run.sampler, "denoiser": run.problem}
        if run.failure is None:
            # The comparison lacks these metrics, as the network has no exact draws.
            values = measure(problem, comparison.draws(run.problem, run.sampler), SEED)
            row |= {metric: values[metric] for metric in metrics}
        else:
            row["failed"] = str(run.failure)
        rows.append(row)
        print(row, flush=True)
    return pd.DataFrame(rows)


PARTS = {
    "table": table,
    "sets": sets,
    "tracks": tracks,
    "conditioned": conditioned,
    "times": times,
    "exact": exact,
}


def main() -> None:
    """Run the selected parts; each writes a table to ``--out``."""
    parser = arguments(__doc__, PARTS)
    parser.add_argument("--data", type=Path, default=CLIPS, help="Folder of the clips.")
    parser.add_argument("--draws", type=int, help="Number of motions per sampler.")
    parser.add_argument("--iterations", type=int, help="Iterations of SDS.")
    parser.add_argument("--steps", type=int, default=4000, help="Training steps of networks.")
    parser.add_argument(
        "--device", default="cpu", help="Of the diffusion model: cpu, cuda or auto."
    )
    parser.add_argument("--workers", type=int, default=0, help="Number of processes.")
    parser.add_argument("--predictions", type=Path, help="Motions of an external lifter, npz.")
    priors = ("walk2d", "motion2d")
    parser.add_argument("--prior", choices=priors, default=priors[0], help="Prior to draw from.")
    options = parser.parse_args()
    study = Study(
        out=options.out,
        data=options.data,
        quick=options.quick,
        draws=options.draws or (24 if options.quick else 256),
        iterations=options.iterations or (50 if options.quick else 10_000),
        repeats=10,
        steps=options.steps,
        device=options.device,
        workers=options.workers,
        name=options.prior,
        predictions=options.predictions,
    )
    run_parts(study, PARTS, options.parts)


if __name__ == "__main__":
    main()

"""Ablations of Motion-DVAE denoising (Fiche et al. 2023, table 2), filters, speed and calibration.

    python notebooks/ablations/motion_dvae.py --out dvae
    python notebooks/ablations/motion_dvae.py --quick --out quick   (synthetic clips, tiny networks)

``--parts`` selects table, trainings, speed, recording and posterior. Recordings are simulated from
held-out clips with noise, outliers and occluded limbs. The package includes the prior and its
denoiser; the networks of the ablations "no prior" and "no noisy training" are trained here for as
many steps, for ``trainings`` with the seeds of ``--seeds``, beside the full network. Draws are
stored in ``--out/comparisons``. Clips are read from ``--data``, by default ../shared/data of the
repository.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import NullFormatter
from parts import CLIPS, arguments, run_parts

from probmotion import seeds
from probmotion.comparison import compare
from probmotion.data.denoising_clips import denoising_clips, synthetic_denoising_clips
from probmotion.data.joint_filters import filled_between, kalman_smooth, savitzky_golay
from probmotion.files import written_whole
from probmotion.io.recordings import read_recording
from probmotion.metrics import accuracy
from probmotion.models import GaussianMixtureMotion, SpectralMixtureMotion
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.dvae.denoiser_training import DenoiserTrainee, usual_denoiser_training
from probmotion.models.dvae.joint_noise import JointNoise
from probmotion.models.dvae.motion_denoiser import MotionDenoiser
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.noisy_windows import Stitching
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.training import DVAETrainee, usual_dvae_training
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.models.training.checkpoints import weights_digest
from probmotion.models.training.trainer import train
from probmotion.motion.motion import Motion
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.denoising import body_of, body_prior, gaussian_noise, limb_occlusions
from probmotion.samplers import NUTS, DVAEInference

FRAMES = 60
BALANCING = "S00_P00_T01_BalancingTrial_multiview.npz"
KINDS: Mapping[str, tuple[float, float | None, str]] = {
    "noise": (0.04, None, "nothing"),
    "outliers": (0.03, 3.0, "nothing"),
    "occluded": (0.04, None, "for a while"),
    "cut off": (0.04, None, "from the ends"),
}
"""Noise scale in metres, degrees of freedom, and frames in which limbs are occluded."""


VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "no prior": {"latent_weight": 0.0},
    "no noisy training": {"noise": JointNoise.nearly_clean()},
}
"""Settings of the denoisers of the ablations that require training."""


@dataclass(frozen=True)
class Recording:
    """Held-out motion, its noisy joints and a mask of occluded joints."""

    truth: Motion
    observed: Joints3D
    hidden: np.ndarray


Estimate = Callable[[Recording], np.ndarray]


@dataclass(frozen=True)
class Study:
    """Clips, networks and number of recordings."""

    out: Path
    data: Path
    quick: bool
    per_clip: int
    seed: int = 0
    seeds: Sequence[int] = (0, 1, 2)

    @cached_property
    def clips(self) -> dict[str, list[Motion]]:
        """3D clips by part."""
        return synthetic_denoising_clips(24) if self.quick else denoising_clips(self.data)

    @cached_property
    def prior(self) -> MotionDVAE:
        """The prior with its denoiser."""
        if not self.quick:
            return body_prior()
        skeleton = self.clips["train"][0].skeleton
        rest = rest_pose(skeleton, [clip.positions for clip in self.clips["train"]])
        settings, annealing = usual_dvae_training("tiny")
        trainee = DVAETrainee(
            self.clips["train"],
            self.clips["validation"],
            DVAESettings.tiny(),
            BodyStates(skeleton, rest),
            annealing=annealing,
        )
        train(trainee, settings, self.out / "networks" / "dvae", progress=False)
        prior = MotionDVAE.load(self.out / "networks" / "dvae")
        return prior.of(inference_network=self.trained("full", prior))

    def trained(
        self, name: str, prior: MotionDVAE, seed: int = 0, **changes: object
    ) -> MotionDenoiser:
        """Return a denoiser trained here for as many steps as the included one."""
        settings, annealing = usual_denoiser_training("tiny" if self.quick else "small")
        trainee = DenoiserTrainee(
            self.clips["train"],
            self.clips["validation"],
            prior,
            annealing=annealing,
            seed=seed,
            **changes,  # type: ignore[arg-type]
        )
        folder = self.out / "networks" / (f"{name}, seed {seed}" if seed else name)
        train(trainee, replace(settings, seed=seed), folder, progress=not self.quick)
        return MotionDenoiser.load(folder, prior)

    def recordings(self, kind: str) -> list[Recording]:
        """Return the recordings of a kind, evenly spaced in the test clips."""
        noise, freedom, occlusion = KINDS[kind]
        recordings = []
        for clip in self.clips["test"]:
            frames = min(FRAMES, clip.frames)
            last_start = clip.frames - frames
            # Clips of at most FRAMES frames provide one recording.
            count = min(self.per_clip, last_start // (frames // 2) + 1)
            for start in np.linspace(0, last_start, count).astype(int):
                truth = replace(clip.window(int(start), frames), name=f"{clip.name}/{start}")
                hidden = limb_occlusions(truth, cut_off=occlusion == "from the ends")
                hidden &= occlusion != "nothing"
                observed = Joints3D.observe(
                    truth,
                    noise,
                    seeds.integer(self.seed, kind, truth.name) % 2**31,
                    hidden=hidden,
                    degrees_of_freedom=freedom,
                )
                recordings.append(Recording(truth, observed, hidden))
        return recordings

    def posterior(
        self, recording: Recording, network: MotionDenoiser | None = None
    ) -> MotionPosterior:
        """Return the posterior of a recording, with ``network`` for inference if given."""
        prior = self.prior.of(
            frames=recording.truth.frames,
            body=body_of(recording.observed, self.prior),
            inference_network=network,
        )
        return MotionPosterior(prior, recording.observed)

    def dvae(
        self, sampler: DVAEInference, network: MotionDenoiser | None = None, average: bool = True
    ) -> Estimate:
        """Return a function that denoises a recording with Motion-DVAE."""

        def estimate(recording: Recording) -> np.ndarray:
            posterior = self.posterior(recording, network)
            return sampler.predict(posterior, average=average, progress=False).positions

        return estimate


def noisy(recording: Recording) -> np.ndarray:
    """Return the noisy joints, with occluded joints interpolated."""
    return filled_between(recording.observed.joints, ~recording.hidden)


def filtered(recording: Recording) -> np.ndarray:
    """Return the estimate of a Savitzky-Golay filter."""
    return savitzky_golay(recording.observed.joints, ~recording.hidden, fps=recording.truth.fps)


def smoothed(recording: Recording) -> np.ndarray:
    """Return the mean of a Kalman smoother; Student-t noise is replaced by Gaussian noise."""
    observed = recording.observed
    mean, _ = kalman_smooth(
        observed.joints,
        observed.entries.confidence,
        noise=gaussian_noise(observed),
        fps=recording.truth.fps,
    )
    return mean


def mixture(study: Study) -> Estimate:
    """Return a function that computes the exact mean under a Gaussian-mixture prior."""
    frames = study.prior.settings.frames
    clips = [clip for clip in study.clips["train"] if clip.frames >= frames]
    order = list(clips[0].skeleton.mirrored_order)
    # As in the training of the DVAE, mirrored clips are included.
    mirrored = [replace(c, positions=c.positions[:, order] * [-1.0, 1.0, 1.0]) for c in clips]
    known = GaussianMixtureMotion.fit(
        [*clips, *mirrored], frames, rank=20, styles=4 if study.quick else 6, seed=study.seed
    )
    root = known.skeleton.roots[0]

    def estimate(recording: Recording) -> np.ndarray:
        observed = recording.observed
        stitching = Stitching(recording.truth.frames, frames, frames // 3)
        means = []
        for joints, confidence in zip(
            stitching.cut(observed.joints), stitching.cut(observed.entries.confidence), strict=True
        ):
            # The mixture models root-centred motions.
            seen = confidence[:, root] > 0
            centre = joints[seen, root].mean(axis=0)
            centred = Joints3D(joints - centre, gaussian_noise(observed), confidence)
            means.append(known.exact_posterior(centred).mean() + centre)
        return stitching.mean(np.stack(means))

    return estimate


def spectral(study: Study) -> Estimate:
    """Return a function that computes the exact mean under a spectral mixture."""
    shipped = None if study.quick else SpectralMixtureMotion.load("cmu-motion")
    known = shipped or SpectralMixtureMotion.fit(study.clips["train"], 30, progress=False)

    def estimate(recording: Recording) -> np.ndarray:
        observed = recording.observed
        found = denoise_joints(
            observed.joints,
            observed.entries.confidence,
            skeleton=known.skeleton,
            fps=recording.truth.fps,
            noise=observed.noise,
            degrees_of_freedom=observed.degrees_of_freedom,
            draws=0,
            progress=False,
            prior=known,
        )
        return found.mean

    return estimate


def estimates(study: Study) -> dict[str, Estimate]:
    """Return the denoising methods by name."""
    fit = DVAEInference(mode="optimization", iterations=50)
    regression = DVAEInference()
    known = mixture(study)
    no_prior, no_noise = (study.trained(name, study.prior, **VARIANTS[name]) for name in VARIANTS)
    without_prior = replace(fit, latent_weight=0.0)
    return {
        "noisy input": noisy,
        "Savitzky-Golay": filtered,
        "Kalman smoother": smoothed,
        "Gaussian mixture, exact mean": known,
        "spectral mixture, exact mean": spectral(study),
        "regression": study.dvae(regression),
        "optimization": study.dvae(fit),
        "optimization, 100 iterations": study.dvae(replace(fit, iterations=100)),
        "NN output, regression": study.dvae(regression, average=False),
        "NN output, optimization": study.dvae(fit, average=False),
        "no prior, regression": study.dvae(regression, no_prior),
        "no prior, optimization": study.dvae(without_prior, no_prior),
        "no noisy training, regression": study.dvae(regression, no_noise),
        "no noisy training, optimization": study.dvae(fit, no_noise),
        "Gaussian noise, optimization": study.dvae(replace(fit, degrees_of_freedom=math.inf)),
        "Student-t noise, optimization": study.dvae(replace(fit, degrees_of_freedom=4.0)),
        "as published, optimization": study.dvae(DVAEInference.paper()),
    }


def errors_of(recording: Recording, estimate: np.ndarray) -> dict[str, float]:
    """Return the errors of an estimate in mm, and its acceleration ratio."""
    truth = recording.truth.positions
    root = recording.truth.skeleton.roots[0]
    local = accuracy.joint_errors(
        accuracy.aligned_by_root(estimate, root), accuracy.aligned_by_root(truth, root)
    )
    world = accuracy.joint_errors(estimate, truth)
    row = {"mpjpe": local.mean(), "g_mpjpe": world.mean()}
    if recording.hidden.any():
        for name, mask in (("visible", ~recording.hidden), ("occluded", recording.hidden)):
            row[f"mpjpe_{name}"] = accuracy.mean_over(local, mask)
            row[f"g_mpjpe_{name}"] = accuracy.mean_over(world, mask)
    row = {name: 1000 * float(value) for name, value in row.items()}
    row["acceleration_ratio"] = float(accuracy.acceleration_ratio(estimate, truth))
    return row


def table(study: Study) -> pd.DataFrame:
    """Return mean errors of every method, by kind of recording.

    Stored rows of ``--out/table.csv`` are reused. They must have the same networks and number of
    recordings.
    """
    stored = study.out / "table.csv"
    rows = pd.read_csv(stored).to_dict("records") if stored.exists() else []
    origin = {"per_clip": study.per_clip, "weights": weights_digest(study.prior.model)[:12]}
    for row in rows:
        if any(str(row.get(name)) != str(value) for name, value in origin.items()):
            raise ValueError(f"{stored} must have rows of {origin}; use another --out")
    finished = {(row["kind"], row["estimate"]) for row in rows}
    methods = estimates(study)
    for kind in KINDS:
        recordings = study.recordings(kind)
        for name, estimate in methods.items():
            # "Gaussian noise" equals "optimization" if the simulated noise is Gaussian.
            same = name.startswith("Gaussian") and KINDS[kind][1] is None
            if same or (kind, name) in finished:
                continue
            errors = table_row(recordings, estimate)
            rows.append({"kind": kind, "estimate": name, **errors, **origin})
            print(rows[-1], flush=True)
            with written_whole(stored) as path:
                pd.DataFrame(rows).to_csv(path, index=False)
    return pd.DataFrame(rows)


def table_row(recordings: list[Recording], estimate: Estimate) -> dict[str, float]:
    """Return the mean errors of one method, or only the number of failures if there are any.

    A mean over the successful recordings is not comparable with other rows.
    """
    started = time.perf_counter()
    estimates, failed = [], 0
    for recording in recordings:
        try:
            estimates.append((recording, estimate(recording)))
        except ValueError as error:
            failed += 1
            print(f"{recording.truth.name}: {error}", flush=True)
    seconds = time.perf_counter() - started
    row: dict[str, float] = {"recordings": len(recordings), "failed": failed}
    if failed:
        return row
    errors = pd.DataFrame([errors_of(*pair) for pair in estimates])
    # Recordings of a clip are correlated, so standard errors are computed over clips.
    clips = errors.groupby([one.truth.name.partition("/")[0] for one in recordings]).mean()
    frames = sum(recording.truth.frames for recording in recordings)
    return row | {
        **errors.mean().to_dict(),
        "g_mpjpe_error": clips["g_mpjpe"].std() / math.sqrt(len(clips)),
        "g_mpjpe_median": errors["g_mpjpe"].median(),
        "seconds_per_frame": seconds / frames,
    }


def trainings(study: Study) -> pd.DataFrame:
    """Return errors with denoisers trained with several seeds: mean and standard deviation.

    A seed determines initial weights, batches and their noise; the motion prior and the recordings
    are the same.
    """
    methods = {
        "regression": DVAEInference(),
        "optimization": DVAEInference(mode="optimization", iterations=50),
    }
    rows = []
    for seed in study.seeds:
        for variant in ("full", *VARIANTS):
            changes = VARIANTS.get(variant, {})
            network = study.trained(variant, study.prior, seed, **changes)
            for kind in ("noise", "occluded"):
                for name, method in methods.items():
                    if variant == "no prior" and name == "optimization":
                        method = replace(method, latent_weight=0.0)
                    errors = table_row(study.recordings(kind), study.dvae(method, network))
                    row = {"kind": kind, "estimate": name, "variant": variant, "seed": seed}
                    print(row, errors.get("g_mpjpe"), flush=True)
                    rows.append(row | errors)
    index, columns = ["kind", "estimate", "variant"], ["g_mpjpe", "g_mpjpe_occluded"]
    table = pd.DataFrame(rows).groupby(index, sort=False)[columns].agg(["mean", "std"])
    table.columns = ["_".join(names) for names in table.columns]
    return table.reset_index()


def speed(study: Study) -> pd.DataFrame:
    """Return errors and duration by number of iterations, with occluded limbs."""
    recordings = study.recordings("occluded")
    rows = []
    for iterations in (0, 10, 25, 50, 100) if study.quick else (0, 10, 25, 50, 100, 200):
        sampler = (
            DVAEInference(mode="optimization", iterations=iterations)
            if iterations
            else DVAEInference()
        )
        estimate = study.dvae(sampler)
        started = time.perf_counter()
        estimates = [estimate(recording) for recording in recordings]
        seconds = time.perf_counter() - started
        errors = pd.DataFrame(
            [errors_of(*pair) for pair in zip(recordings, estimates, strict=True)]
        )
        frames = sum(recording.truth.frames for recording in recordings)
        rows.append(
            {
                "iterations": iterations,
                "seconds_per_frame": seconds / frames,
                **errors.mean().to_dict(),
            }
        )
        print(rows[-1], flush=True)
    results = pd.DataFrame(rows)
    figure, left = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, label in (("g_mpjpe", "all joints"), ("g_mpjpe_occluded", "occluded joints")):
        left.plot(results["seconds_per_frame"], results[name], "o-", label=label)
    for _, row in results.iterrows():
        left.annotate(f"{row['iterations']:.0f}", (row["seconds_per_frame"], row["g_mpjpe"]))
    left.set(xscale="log", xlabel="seconds per frame", ylabel="G-MPJPE, mm")
    left.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    left.xaxis.set_minor_formatter(NullFormatter())
    left.legend()
    with written_whole(study.out / "speed.png") as path:
        figure.savefig(path, format="png", dpi=150)
    plt.close(figure)
    return results


def recording(study: Study) -> pd.DataFrame:
    """Return distances to the filtered joints of the real four-camera recording.

    The noisy input is triangulated frame by frame; the authors' filtered joints are not ground
    truth. Limbs are occluded as in the simulated recordings.
    """
    real = read_recording(study.data / "pose2sim_multiview" / BALANCING)
    # The rms difference of coordinates from the filtered joints is 1.8 cm, that of Student-t noise
    # with four degrees of freedom and this scale.
    scale = 0.0126
    rows = []
    for occlusion in (False, True):
        truth = Motion(real.filtered, real.skeleton, real.fps, name=real.name)
        hidden = (limb_occlusions(truth) & occlusion) | ~real.seen
        observed = Joints3D(
            real.joints, scale, (~hidden).astype(float), 4.0, real.skeleton, real.fps
        )
        one = Recording(truth, observed, hidden)
        fit = DVAEInference(mode="optimization", iterations=50)
        methods = {
            "noisy input": noisy,
            "Savitzky-Golay": filtered,
            "Kalman smoother": smoothed,
            "spectral mixture, exact mean": spectral(study),
            "regression": study.dvae(DVAEInference()),
            "optimization": study.dvae(fit),
            "optimization, 200 iterations": study.dvae(replace(fit, iterations=200)),
        }
        for name, estimate in methods.items():
            rows.append({"hidden": occlusion, "estimate": name, **errors_of(one, estimate(one))})
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class StartedNUTS:
    """NUTS initialised at draws of Motion-DVAE; its duration excludes that of Motion-DVAE."""

    name: ClassVar[str] = "nuts"
    requires: ClassVar[tuple[type, ...]] = NUTS.requires

    start: DVAEInference
    nuts: NUTS

    def sample(
        self, posterior: MotionPosterior, *, chains: int, seed: int, progress: bool, **options: Any
    ) -> MotionDraws:
        """Return NUTS draws; each chain starts at a Motion-DVAE draw."""
        started = self.start.sample(posterior, draws=1, chains=chains, seed=seed, progress=progress)
        options["initial"] = started.dataset["theta"].values[:, 0]
        return self.nuts.sample(posterior, chains=chains, seed=seed, progress=progress, **options)


def posterior(study: Study) -> pd.DataFrame:
    """Return the calibration of draws: spread, error and coverage of central 90 % intervals.

    The recording is one window of a held-out clip, which is short enough for NUTS.
    """
    recording = study.recordings("occluded")[0]
    frames = study.prior.settings.frames
    truth = recording.truth.window(0, frames)
    hidden = limb_occlusions(truth)
    observed = Joints3D.observe(truth, KINDS["occluded"][0], study.seed, hidden=hidden)
    problem = Problem(
        "occluded",
        "a window of a held-out clip in which limbs hide",
        study.posterior(Recording(truth, observed, hidden)),
        truth=truth.positions,
    )
    fit = DVAEInference(mode="optimization", iterations=50 if study.quick else 200)
    nuts = NUTS(warmup=10 if study.quick else 150, max_tree_depth=3 if study.quick else 6)
    # Fewer draws of NUTS, since each is much more expensive than a draw of the networks.
    grids: tuple[tuple[str, dict[str, Sampler], int], ...] = (
        ("dvae", {"dvae, regression": DVAEInference(), "dvae, optimization": fit}, 200),
        ("nuts", {"nuts": StartedNUTS(fit, nuts)}, 10 if study.quick else 100),
    )
    rows = []
    for name, samplers, draws in grids:
        comparison = compare(
            problem,
            samplers,
            draws=draws,
            chains=1,
            out=study.out / "comparisons" / name,
            workers=0,
            progress=not study.quick,
        )
        for run in comparison.results:
            row: dict[str, object] = {"sampler": run.sampler}
            if run.failure is None:
                drawn = comparison.draws(run.problem, run.sampler)
                row |= draw_accuracy(drawn.flat(), truth, hidden)
                row["log_density"] = float(drawn.dataset["log_density"].mean())
                row["seconds"] = run.metrics["seconds"]
            else:
                row["failed"] = str(run.failure)
            rows.append(row)
            print(row, flush=True)
    return pd.DataFrame(rows)


def draw_accuracy(drawn: np.ndarray, truth: Motion, hidden: np.ndarray) -> dict[str, float]:
    """Return spread and error of draws in mm, and coverage of central 90 % intervals."""
    middle = drawn.mean(axis=0)
    spread = np.sqrt(((drawn - middle) ** 2).sum(axis=-1).mean(axis=0))
    error = np.linalg.norm(middle - truth.positions, axis=-1)
    low, high = np.quantile(drawn, [0.05, 0.95], axis=0)
    inside = (truth.positions >= low) & (truth.positions <= high)
    row = {}
    for name, mask in (("seen", ~hidden), ("occluded", hidden)):
        if mask.any():
            row[f"spread_{name}_mm"] = 1000 * float(spread[mask].mean())
            row[f"error_{name}_mm"] = 1000 * float(error[mask].mean())
            row[f"inside_{name}"] = float(inside[mask].mean())
    return row


PARTS = {
    "table": table,
    "trainings": trainings,
    "speed": speed,
    "recording": recording,
    "posterior": posterior,
}


def main() -> None:
    """Run the selected parts; each writes a table to ``--out``."""
    parser = arguments(__doc__, PARTS)
    parser.add_argument("--data", type=Path, default=CLIPS, help="Folder of the clips.")
    parser.add_argument("--per-clip", type=int, default=6, help="Recordings per test clip.")
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[0, 1, 2], help="Seeds of the part trainings."
    )
    options = parser.parse_args()
    per_clip = 2 if options.quick else options.per_clip
    study = Study(options.out, options.data, options.quick, per_clip, seeds=options.seeds)
    # There is no made recording.
    parts = [name for name in options.parts if name != "recording" or not study.quick]
    run_parts(study, PARTS, parts)


if __name__ == "__main__":
    main()

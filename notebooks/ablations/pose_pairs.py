"""Ablations of pose-pair sampling on CMU salsa: Yin et al. (2018), section 6, figures 6 to 9.

    python notebooks/ablations/pose_pairs.py --out pose-pairs
    python notebooks/ablations/pose_pairs.py --quick --out quick     (synthetic dances, minutes)

``--parts`` selects noise, calibration, paired, truncation, velocity, coverage and embedding; each
writes a CSV file and figures to ``--out``. All draw with ``mh`` from the seed, as in the paper; such
chains do not mix, those of ``mixed_pairs.py`` do. Draws are stored in ``--out/comparisons`` (3 GB in
total); run the same command again to resume an interrupted study. The part embedding uses the draws
of the part coverage. The data are located by :func:`probmotion.data.downloads.salsa_pairs`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from parts import arguments, run_parts

from probmotion import seeds
from probmotion.comparison import Comparison, compare
from probmotion.data.downloads import salsa_pairs
from probmotion.data.pair_sets import (
    SALSA_HELD_OUT,
    choose_seed,
    dance_frames,
    ground_truth,
    hold_out,
)
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import DrawnAnnotations, draw_annotations
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.geometry.pose_distances import MEASURES, pose_distances
from probmotion.metrics.coverage import coverage
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.calibration_curves import draw_calibration
from probmotion.plots.coverage import classical_scaling, draw_coverage, draw_embedding
from probmotion.plots.pairs import draw_pairs
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.posteriors.truncation import TruncatedPosterior, limit_for_dimension
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic, Proposal, VelocityBiased

SEED = 0
# σ_l of the part "coverage", chosen by the part "noise" on the validation clips: the value with the
# best coverage, except for interaction coordinates, where it is the middle of the three best.
VALIDATION = ("cmu_60_61_02", "cmu_60_61_10")
NOISE = {"interaction": 0.005, "cartesian": 0.01, "shape-context": 0.005}


@dataclass(frozen=True, eq=False)
class Runs:
    """Comparison of a part, and the settings of its problems by name."""

    settings: Mapping[str, Mapping[str, Any]]
    comparison: Comparison

    def draws(self, problem: str, sampler: str = "isotropic") -> MotionDraws | None:
        """Return the draws of a run; None if it failed."""
        failed = {(run.problem, run.sampler) for run in self.comparison.failures}
        return None if (problem, sampler) in failed else self.comparison.draws(problem, sampler)


@dataclass(frozen=True)
class Study:
    """Data and size of the study."""

    out: Path
    quick: bool
    draws: int
    chains: int
    warmup: int
    repeats: int
    n_annotations: int
    n_held_out: int
    validating: bool = False

    @cached_property
    def clips(self) -> tuple[list, list]:
        """Training clips and held-out clips.

        With ``validating``, validation clips are held out of the training clips instead.
        """
        if self.quick:
            training, test = hold_out(synthetic_dances(8), ["dance-6", "dance-7"])
        else:
            training, test = hold_out(salsa_pairs(), SALSA_HELD_OUT)
        if self.validating:
            return hold_out(training, ["dance-5"] if self.quick else VALIDATION)
        return training, test

    @cached_property
    def training_poses(self) -> np.ndarray:
        """All dance frames of the training clips, (n, J, 3)."""
        return ground_truth(self.clips[0])[0]

    @cached_property
    def held_out(self) -> np.ndarray:
        """Held-out pose pairs, (G, J, 3)."""
        return ground_truth(self.clips[1], self.n_held_out)[0]

    @cached_property
    def seed_pose(self) -> np.ndarray:
        """The 3D seed pose of both people, (J, 3)."""
        return self.training_poses[choose_seed(self.training_poses)]

    def drawn_annotations(self, repeat: int) -> DrawnAnnotations:
        """Return 2D annotations and their 3D poses, different in every repeat."""
        frames = [dance_frames(clip) for clip in self.clips[0]]
        n = min(self.n_annotations, sum(int(mask.sum()) for mask in frames))
        return draw_annotations(self.clips[0], n, repeat, frames=frames)

    def posterior(
        self, density: str = "interaction", repeat: int = 0, **changes: object
    ) -> TruncatedPosterior:
        """Return the posterior for a measure of dissimilarity, or ``"prior"`` for the prior."""
        if density == "prior":
            return pair_posterior(self.seed_pose, None, replace(PairSettings(), **changes))
        settings = replace(PairSettings(measure=density, noise=NOISE[density]), **changes)
        annotations = self.drawn_annotations(repeat).annotations
        return pair_posterior(self.seed_pose, annotations, settings, view_seed=repeat)

    def run(
        self,
        part: str,
        settings: Mapping[str, Mapping[str, Any]],
        proposals: Mapping[str, Proposal] | None = None,
        draws: int | None = None,
    ) -> Runs:
        """Return the comparison of proposals, with all states after warm-up, started at the seed.

        Each repeat has different annotations and views and is a separate problem.
        """
        samplers = {
            name: MetropolisHastings(proposal, warmup=self.warmup, thin=1)
            for name, proposal in (proposals or {"isotropic": Isotropic(0.02)}).items()
        }
        return self.compared(part, settings, samplers, draws or self.draws // 10)

    def compared(
        self,
        part: str,
        settings: Mapping[str, Mapping[str, Any]],
        samplers: Mapping[str, Sampler],
        draws: int,
    ) -> Runs:
        """Return the comparison of samplers on the posteriors with these settings."""
        problems = {
            name: Problem(
                name,
                "pose-pairs of clips that were held out: coverage",
                self.posterior(**changes),
                held_out=self.held_out[:, None],
            )
            for name, changes in settings.items()
        }
        comparison = compare(
            problems,
            samplers,
            draws=draws,
            chains=self.chains,
            out=self.out / "comparisons" / part,
            workers=0,
            progress=not self.quick,
        )
        for run in comparison.failures:
            print(f"{part}: {run.sampler} on {run.problem} failed, {run.failure}")
        return Runs(settings, comparison)

    @cached_property
    def by_density(self) -> Runs:
        """Draws of the part "coverage" from four densities, and of "embedding"."""
        problems = {
            f"{density}, repeat {repeat}": {"density": density, "repeat": repeat}
            for density in ("interaction", "cartesian", "prior", "shape-context")
            # Shape contexts are several times more expensive, so they have one repeat.
            for repeat in range(1 if density == "shape-context" else self.repeats)
        }
        return self.run("coverage", problems, draws=self.draws)

    def table(
        self, runs: Runs, fewer: Sequence[int] = (), also: Sequence[str] = ()
    ) -> pd.DataFrame:
        """Return the coverage of every run by all draws, and by the first draws of all chains.

        ``fewer`` lists numbers of first draws, ``also`` additional metrics of the comparison.
        """
        rows = []
        for run in runs.comparison.results:
            row = dict(runs.settings[run.problem])
            if len(runs.comparison.plan.samplers) > 1:
                row["proposal"] = run.sampler
            covered = {
                (measure, runs.comparison.plan.draws): run.metrics.get(
                    f"coverage_{measure}", np.nan
                )
                for measure in MEASURES
            }
            draws = runs.draws(run.problem, run.sampler)
            if draws is None:
                row["failed"] = str(run.failure)
            else:
                row |= {name: run.metrics[name] for name in ("acceptance", *also)}
                row["scale"] = float(np.exp(draws.state["proposal_log_scale"]).mean())
                row |= {
                    "ess": run.metrics.get("ess_bulk", np.nan),
                    "seconds": run.metrics["seconds"],
                }
                covered = self.covered(step_by_step(draws), fewer) | covered
            rows += [
                {"measure": measure, "draws": count, "coverage": value, **row}
                for (measure, count), value in covered.items()
            ]
        return pd.DataFrame(rows)

    def covered(self, poses: np.ndarray, counts: Sequence[int]) -> dict[tuple[str, int], float]:
        """Return the coverage by the first poses, for each measure and number of poses."""
        if not counts:
            return {}
        return {
            (measure, count): float(value)
            for measure in MEASURES
            for count, value in zip(
                counts, coverage(self.held_out, poses, measure, counts), strict=True
            )
        }

    def draw_states(
        self, runs: Mapping[str, MotionDraws | None], path: Path, compared: str
    ) -> None:
        """Plot states of the first chain as in the paper, aligned to the seed."""
        rows = {}
        for label, draws in runs.items():
            if draws is not None:
                last = draws.positions.sizes["draw"] - 1
                chosen = [min(number, last) for number in (200, 400, 600, 800)]
                poses = draws.positions.values[0, chosen, 0]
                rows[label] = align_rigidly(poses, np.broadcast_to(self.seed_pose, poses.shape))
        if rows:
            draw_pairs(
                rows,
                Skeleton.preset("pair17"),
                path,
                columns=4,
                title=f"states 200, 400, 600 and 800 of a chain, by {compared}",
            )


S = TypeVar("S", bound=Study)


def step_by_step(draws: MotionDraws) -> np.ndarray:
    """Return the poses of all chains in order of steps, (chains × draws, J, 3)."""
    poses = np.swapaxes(draws.positions.values[:, :, 0], 0, 1)
    return poses.reshape(-1, *poses.shape[2:])


def evenly(poses: np.ndarray, n: int) -> np.ndarray:
    """Return about n evenly spaced poses."""
    return poses[:: max(1, len(poses) // n)]


def levels(posterior: TruncatedPosterior, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return the log prior, log likelihood and log posterior of poses (n, J, 3)."""
    motions = poses[:, None]
    prior = posterior.prior.log_plausibility(motions)
    likelihood = posterior.likelihood.log_density(motions)
    return {"log prior": prior, "log likelihood": likelihood, "log posterior": prior + likelihood}


def calibration(study: Study) -> pd.DataFrame:
    """Return log densities of real pairs, the seed and draws at several σ_l."""
    rng = seeds.generator(SEED, "calibration")
    real = study.training_poses[
        rng.choice(len(study.training_poses), min(400, len(study.training_poses)), False)
    ]
    sizes = {f"noise {size}": size for size in (0.005, PairSettings().noise, 0.02)}
    runs = study.run("calibration", {name: {"noise": size} for name, size in sizes.items()})
    rows = []
    for name, size in sizes.items():
        posterior = study.posterior(noise=size)
        poses = {"real pairs": real}
        if (draws := runs.draws(name)) is not None:
            poses["draws"] = evenly(step_by_step(draws), 400)
        poses["seed"] = study.seed_pose[None]
        log_densities = {kind: levels(posterior, kind_poses) for kind, kind_poses in poses.items()}
        if size == PairSettings().noise:
            draw_calibration(log_densities, study.out / "calibration.png")
        rows += [
            (size, kind, part, *np.percentile(values, [10, 50, 90]).round(1))
            for kind, parts in log_densities.items()
            for part, values in parts.items()
        ]
    return pd.DataFrame(rows, columns=["noise", "of", "part", "10 %", "median", "90 %"])


def noise(study: Study) -> pd.DataFrame:
    """Return acceptance, step size and coverage of the validation clips by σ_l."""
    study = replace(study, validating=True)
    scales = {
        "interaction": (0.003, 0.005, 0.01, 0.02, 0.05),
        "cartesian": (0.0025, 0.005, 0.01, 0.02),
        "shape-context": (0.005, 0.01, 0.02),
    }
    problems = {
        f"{density} {size}, repeat {repeat}": {"density": density, "noise": size, "repeat": repeat}
        for repeat in range(study.repeats)
        for density, sizes in scales.items()
        for size in sizes
    }
    return study.table(study.run("noise", problems))


def paired(study: Study) -> pd.DataFrame:
    """Return coverage of both coordinates at equal σ_l, annotations and views."""
    problems = {
        f"{density} {size}, repeat {repeat}": {"density": density, "noise": size, "repeat": repeat}
        for repeat in range(study.repeats)
        for size in (0.005, 0.01)
        for density in ("interaction", "cartesian")
    }
    return study.table(study.run("paired", problems))


def truncation(study: Study) -> pd.DataFrame:
    """Return coverage and fractions of draws at the density bounds, by c of eq. 11."""
    problems = {
        f"limit {limit:.3g}, repeat {repeat}": {"limit": limit, "repeat": repeat}
        for repeat in range(study.repeats)
        for limit in (100.0, limit_for_dimension(108), np.inf)
    }
    return study.table(study.run("truncation", problems), also=("at_cap", "near_floor"))


def velocity(study: Study) -> pd.DataFrame:
    """Return coverage by proposal at equal acceptance and number of draws (figure 7)."""
    proposals = {
        "isotropic": Isotropic(0.02),
        "biased-1": VelocityBiased(base=0.02, bias=1.0),
        "biased-10": VelocityBiased(base=0.02, bias=10.0),
        "velocity-alone": VelocityBiased(base=0.001, bias=1.0),
    }
    problems = {f"repeat {repeat}": {"repeat": repeat} for repeat in range(study.repeats)}
    runs = study.run("velocity", problems, proposals)
    study.draw_states(
        {
            "unbiased": runs.draws("repeat 0"),
            "velocity-\nbiased": runs.draws("repeat 0", "biased-1"),
        },
        study.out / "figure7.png",
        "proposal",
    )
    return study.table(runs)


def densities(study: Study) -> pd.DataFrame:
    """Return coverage by number of draws, density and measure (figure 9)."""
    runs = study.by_density
    table = study.table(runs, fewer=(study.draws // 100, study.draws // 10))
    draw_coverage(table, study.out / "figure9.png")
    study.draw_states(
        {
            "prior alone": runs.draws("prior, repeat 0"),
            "prior and\nlikelihood": runs.draws("interaction, repeat 0"),
        },
        study.out / "figure6.png",
        "density",
    )
    rows = [
        {
            "density": name,
            "measure": measure,
            "draws": len(poses),
            "coverage": coverage(study.held_out, poses, measure),
        }
        for name, poses in (
            ("the seed alone", study.seed_pose[None]),
            ("all held-in real pairs", study.training_poses),
        )
        for measure in MEASURES
    ]
    return pd.concat([table, pd.DataFrame(rows)])


def embedding(study: Study) -> pd.DataFrame:
    """Return multidimensional scaling coordinates of draws and real pairs (figure 8)."""
    sets = {"real": evenly(study.held_out, 150)}
    for kind, density in (("prior", "prior"), ("posterior", "interaction")):
        if (draws := study.by_density.draws(f"{density}, repeat 0")) is not None:
            # Subsets of the first 20, of the first 200 and of all 2000 evenly spaced draws.
            states = evenly(step_by_step(draws), 2000)
            sets[kind] = np.concatenate([states[:20:2], states[20:200:4], states[200::18]])
    sets["seed"] = study.seed_pose[None]
    counts = {f"{study.draws // 100} draws": 10, f"{study.draws // 10} draws": 55}
    counts[f"{study.draws} draws"] = sum(map(len, sets.values()))
    return embed(sets, study.out / "figure8.png", counts)


def embed(
    sets: Mapping[str, np.ndarray], path: Path, counts: Mapping[str, int] | None = None
) -> pd.DataFrame:
    """Plot poses by multidimensional scaling of interaction distances; return coordinates."""
    poses = np.concatenate(list(sets.values()))
    kinds = [kind for kind, members in sets.items() for _ in members]
    points = classical_scaling(pose_distances(poses, poses, "interaction"))
    draw_embedding(points, kinds, path, counts=counts)
    return pd.DataFrame({"kind": kinds, "x": points[:, 0], "y": points[:, 1]})


PARTS: dict[str, Callable[[Study], pd.DataFrame]] = {
    "noise": noise,
    "calibration": calibration,
    "paired": paired,
    "truncation": truncation,
    "velocity": velocity,
    "coverage": densities,
    "embedding": embedding,
}


def shown(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """Return the printed table of a part: means over chains."""
    keys = [k for k in ("density", "proposal", "noise", "limit", "draws") if k in table]
    if "measure" not in table:
        return table if name == "calibration" else table.groupby("kind").size().to_frame("poses")
    columns = [
        c for c in ("acceptance", "scale", "ess", "seconds", "at_cap", "near_floor") if c in table
    ]
    means = table.groupby([*keys, "measure"], sort=False)["coverage"].mean()
    wide = means.unstack("measure", sort=False)
    if columns:
        wide = wide.join(table.groupby(keys)[columns].mean())
    return wide.round(4)


def main(
    description: str,
    kind: type[S],
    parts: Mapping[str, Callable[[S], pd.DataFrame]],
    shown: Callable[[str, pd.DataFrame], pd.DataFrame],
) -> None:
    """Run the selected parts of a kind of study and print every table as ``shown`` returns it."""
    parser = arguments(description, parts)
    parser.add_argument("--draws", type=int, help="Draws of all chains; default: 100000.")
    parser.add_argument("--repeats", type=int, default=3, help="Number of repeats.")
    options = parser.parse_args()
    # Parts with a tenth of the draws divide them among four chains.
    given = 400 if options.draws is None else options.draws
    if options.repeats < 1 or given < 400 or given % 40:
        parser.error("--repeats must be at least 1, --draws a multiple of 40 and at least 400")
    study = kind(
        options.out,
        options.quick,
        draws=options.draws or (4000 if options.quick else 100_000),
        chains=4,
        warmup=300 if options.quick else 3000,
        repeats=options.repeats,
        n_annotations=300 if options.quick else 6000,
        n_held_out=40 if options.quick else 300,
    )
    run_parts(study, parts, options.parts, lambda name, table: shown(name, table).to_string())


if __name__ == "__main__":
    main(__doc__, Study, PARTS, shown)

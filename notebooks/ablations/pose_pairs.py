"""Ablations of pose-pair sampling on the salsa clips: Yin et al. (2018), section 6, figures 6 to 9.

    python notebooks/ablations/pose_pairs.py --out pose-pairs
    python notebooks/ablations/pose_pairs.py --quick --out quick     (made dances, minutes)

Parts: noise, calibration, truncation, velocity, coverage, embedding, completion; ``--parts``
chooses. Each leaves a CSV file and pictures in ``--out``. A run that has left its file in
``--out/runs`` is not made again, so that what is interrupted goes on.
Real data are looked for as in :func:`probmotion.data.downloads.salsa_pairs`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pandas as pd

from probmotion import seeds
from probmotion.data.dances import make_dances
from probmotion.data.downloads import salsa_pairs
from probmotion.data.pair_sets import (
    SALSA_HELD_OUT,
    choose_seed,
    dance_frames,
    ground_truth,
    hold_out,
)
from probmotion.draws import MotionDraws
from probmotion.files import written_whole
from probmotion.interaction.annotation_sources import DrawnAnnotations, draw_annotations
from probmotion.interaction.completion import (
    complete_keypoints,
    hidden_joint_error,
    nearest_annotation_completion,
)
from probmotion.interaction.coordinates import align_rigidly
from probmotion.interaction.pose_distances import MEASURES, pose_distances
from probmotion.interaction.views import project_to_views
from probmotion.metrics.chains import chain_diagnostics
from probmotion.metrics.coverage import coverage
from probmotion.models.pair_posterior import PairSettings, pair_posterior
from probmotion.models.single_pose_lifting import lift_people
from probmotion.pictures.calibration import draw_calibration
from probmotion.pictures.coverage import classical_scaling, draw_coverage, draw_embedding
from probmotion.pictures.pairs import draw_pairs
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.proposals import Isotropic, Proposal, VelocityBiased
from probmotion.truncation import TruncatedPosterior, limit_for_dimension

SEED = 0
_EVERY = 4
# Each density at the noise at which it covers best (part "noise").
NOISE = {"interaction": 0.005, "cartesian": 0.005, "shape-context": 0.02}


@dataclass(frozen=True)
class Study:
    """The data, and how much to draw."""

    out: Path
    quick: bool
    steps: int
    chains: int
    warmup: int
    n_annotations: int
    n_held_out: int

    @cached_property
    def clips(self) -> tuple[list, list]:
        """Clips that are shown, and clips that are held out whole."""
        if self.quick:
            return hold_out(make_dances(8), ["dance-6", "dance-7"])
        return hold_out(salsa_pairs(), SALSA_HELD_OUT)

    @cached_property
    def held_in(self) -> np.ndarray:
        """All frames of the dance of the clips that are shown, (n, J, 3)."""
        return ground_truth(self.clips[0])[0]

    @cached_property
    def held_out(self) -> np.ndarray:
        """Pose-pairs to cover, (G, J, 3)."""
        return ground_truth(self.clips[1], self.n_held_out)[0]

    @cached_property
    def pictures(self) -> DrawnAnnotations:
        """Frames that are annotated in 2D, and the truth behind them."""
        frames = [dance_frames(clip) for clip in self.clips[0]]
        n = min(self.n_annotations, sum(int(some.sum()) for some in frames))
        return draw_annotations(self.clips[0], n, SEED, frames=frames)

    @cached_property
    def seed_pose(self) -> np.ndarray:
        """The one 3D pose-pair, (J, 3)."""
        return self.held_in[choose_seed(self.held_in)]

    def posterior(self, density: str, **changes: object) -> TruncatedPosterior:
        """Return the posterior over a density: a measure's name, or ``"prior"``."""
        if density == "prior":
            settings = replace(PairSettings(), **changes)
            return pair_posterior(self.seed_pose, None, settings)
        settings = PairSettings(measure=density, noise=NOISE[density])
        settings = replace(settings, **changes)
        return pair_posterior(self.seed_pose, self.pictures.annotations, settings)

    def run(
        self, posterior: TruncatedPosterior, proposal: Proposal | None = None, steps: int = 0
    ) -> MotionDraws:
        """Return every state of the chains after the warm-up."""
        proposal = Isotropic(0.02) if proposal is None else proposal
        sampler = MetropolisHastings(proposal, warmup=self.warmup, thin=1)
        return sampler.sample(
            posterior, draws=steps or self.steps, chains=self.chains, seed=SEED, progress=False
        )

    def keep(self, name: str, poses: np.ndarray) -> None:
        """Write some draws of every chain, (chains, n, J, 3), for what comes after."""
        with (
            written_whole(self.out / f"poses-{name}.npz") as path,
            open(path, "wb") as file,
        ):
            np.savez_compressed(file, poses=poses.astype(np.float32))

    def kept(self, name: str) -> np.ndarray:
        """Read what :meth:`keep` wrote."""
        with np.load(self.out / f"poses-{name}.npz") as archive:
            return archive["poses"].astype(np.float64)

    def once(self, name: str, make: Callable[[], pd.DataFrame]) -> pd.DataFrame:
        """Return the table of one run; it is made where its file is missing."""
        path = self.out / "runs" / f"{name}.csv"
        if not path.exists():
            start = time.perf_counter()
            table = make()
            path.parent.mkdir(exist_ok=True)
            with written_whole(path) as unfinished:
                table.to_csv(unfinished, index=False)
            print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
        return pd.read_csv(path)

    def covered(
        self, draws: MotionDraws, counts: list[int] | None = None
    ) -> Iterator[tuple[str, int, int, float]]:
        """Yield measure, chain, number of draws and coverage.

        Every fourth draw is compared: the next ones are mostly the same pose or a step away.
        """
        poses = draws.positions.values[:, ::_EVERY, 0]
        wanted = [draws.positions.sizes["draw"]] if counts is None else counts
        for measure in MEASURES:
            for chain, states in enumerate(poses):
                compared = [-(-count // _EVERY) for count in wanted]
                found = coverage(self.held_out, states, measure, compared)
                for count, value in zip(wanted, found, strict=True):
                    yield measure, chain, count, float(value)


def levels(posterior: TruncatedPosterior, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return log prior, log likelihood and their sum of poses, (n, J, 3)."""
    motions = poses[:, None]
    prior = posterior.prior.log_plausibility(motions)
    likelihood = posterior.likelihood.log_density(motions)
    return {"log prior": prior, "log likelihood": likelihood, "log posterior": prior + likelihood}


def calibration(study: Study) -> pd.DataFrame:
    """What the density says of real pairs, of the seed and of draws."""
    posterior = study.posterior("interaction")
    draws = study.run(posterior, steps=max(400, study.steps // 10))
    rng = seeds.generator(SEED, "calibration")
    real = study.held_in[rng.choice(len(study.held_in), min(400, len(study.held_in)), False)]
    drawn = draws.positions.values[:, :: max(1, draws.positions.sizes["draw"] // 100), 0]
    drawn = drawn.reshape(-1, *drawn.shape[2:])
    found = {
        "real pairs": levels(posterior, real),
        "draws": levels(posterior, drawn),
        "seed": levels(posterior, study.seed_pose[None]),
    }
    draw_calibration(found, study.out / "calibration.png")
    rows = [
        (kind, part, *np.percentile(values, [10, 50, 90]).round(2))
        for kind, parts in found.items()
        for part, values in parts.items()
    ]
    return pd.DataFrame(rows, columns=["of", "part", "10 %", "median", "90 %"])


def noise(study: Study) -> pd.DataFrame:
    """σ_l: acceptance, step and coverage; from this the defaults are chosen."""
    scales = {
        "interaction": (0.003, 0.005, 0.01, 0.02, 0.05),
        "cartesian": (0.0025, 0.005, 0.01, 0.02),
        "shape-context": (0.01, 0.02, 0.05, 0.1),
    }

    def run(density: str, size: float) -> pd.DataFrame:
        draws = study.run(study.posterior(density, noise=size), steps=study.steps // 10)
        return coverage_rows(study, draws, density=density, noise=size)

    return pd.concat(
        study.once(f"noise-{density}-{size}", partial(run, density, size))
        for density, sizes in scales.items()
        for size in sizes
    )


def truncation(study: Study) -> pd.DataFrame:
    """c of eq. 11: shares of draws where the density is cut, and coverage."""

    def run(limit: float) -> pd.DataFrame:
        posterior = study.posterior("interaction", limit=limit)
        draws = study.run(posterior, steps=study.steps // 10)
        kept = draws.dataset
        shares = posterior.run_shares(kept["theta"].values, kept["log_density"].values)
        return coverage_rows(study, draws, limit=limit, **shares)

    limits = (100.0, limit_for_dimension(108), np.inf)
    return pd.concat(study.once(f"truncation-{c:.3g}", partial(run, c)) for c in limits)


def velocity(study: Study) -> pd.DataFrame:
    """Biased against unbiased proposals at the same acceptance and number of draws (figure 7)."""
    posterior = study.posterior("interaction")
    proposals = {
        "isotropic": Isotropic(0.02),
        "biased-1": VelocityBiased(base=0.02, bias=1.0),
        "biased-10": VelocityBiased(base=0.02, bias=10.0),
        "velocity-alone": VelocityBiased(base=0.001, bias=1.0),
    }

    def run(name: str) -> pd.DataFrame:
        draws = study.run(posterior, proposals[name], steps=study.steps // 10)
        study.keep(name, draws.positions.values[:1, early(draws), 0])
        return coverage_rows(study, draws, proposal=name)

    table = pd.concat(study.once(name, partial(run, name)) for name in proposals)
    draw_pairs(
        {name: study.kept(name)[0] for name in ("isotropic", "biased-1")},
        posterior.skeleton,
        study.out / "figure7.png",
        columns=4,
        title="draws 200, 400, 600 and 800: unbiased and velocity-biased proposals",
    )
    return table


def densities(study: Study) -> pd.DataFrame:
    """Coverage against the number of draws, four densities, three dissimilarities (figure 9)."""
    counts = sorted({c for c in (100, 1000, 10_000, 100_000) if c < study.steps} | {study.steps})

    def run(density: str) -> pd.DataFrame:
        draws = study.run(study.posterior(density))
        every = max(1, study.steps // 1000)
        study.keep(density, draws.positions.values[:, ::every, 0])
        study.keep(f"{density}-early", draws.positions.values[:1, early(draws), 0])
        rows = study.covered(draws, counts)
        table = pd.DataFrame(rows, columns=["measure", "chain", "draws", "coverage"])
        return table.assign(density=density, **summary(draws))

    names = ("interaction", "cartesian", "prior", "shape-context")
    table = pd.concat(study.once(f"coverage-{name}", partial(run, name)) for name in names)
    rows = []
    for measure in MEASURES:
        seed = coverage(study.held_out, study.seed_pose[None], measure)
        real = coverage(study.held_out, study.held_in, measure)
        rows.append({"density": "the seed alone", "measure": measure, "draws": 1, "coverage": seed})
        rows.append(
            {
                "density": "all held-in real pairs",
                "measure": measure,
                "draws": len(study.held_in),
                "coverage": real,
            }
        )
    draw_coverage(table, study.out / "figure9.png")
    draw_pairs(
        {
            "prior alone": study.kept("prior-early")[0],
            "prior and\nlikelihood": study.kept("interaction-early")[0],
        },
        study.posterior("prior").skeleton,
        study.out / "figure6.png",
        columns=4,
        title="draws 200, 400, 600 and 800 of one chain",
    )
    return pd.concat([table, pd.DataFrame(rows)])


def embedding(study: Study) -> pd.DataFrame:
    """Draws over the space of the real pairs, by multidimensional scaling (figure 8)."""
    sets = {"real": study.held_out[:: max(1, len(study.held_out) // 150)]}
    for kind, density in (("prior", "prior"), ("posterior", "interaction")):
        # Of a thousand draws evenly apart those whose numbers grow tenfold twice.
        states = study.kept(density)[0]
        sets[kind] = np.concatenate([states[:10], states[10:100:2], states[100::9]])
    sets["seed"] = study.seed_pose[None]
    poses = np.concatenate(list(sets.values()))
    kinds = [kind for kind, some in sets.items() for _ in some]
    points = classical_scaling(pose_distances(poses, poses, "interaction"))
    parts = {f"{study.steps // 100} draws": 10, f"{study.steps // 10} draws": 55}
    counts = parts | {f"{study.steps} draws": len(sets["prior"])}
    draw_embedding(points, kinds, study.out / "figure8.png", counts=counts)
    return pd.DataFrame({"kind": kinds, "x": points[:, 0], "y": points[:, 1]})


def completion(study: Study) -> pd.DataFrame:
    """Hidden joints of held-out pairs: error beside the two baselines, in the picture, metres."""
    frames = [dance_frames(clip) for clip in study.clips[1]]
    n = 10 if study.quick else 60
    asked = draw_annotations(study.clips[1], n, SEED, frames=frames, hidden=0.3)
    whole = draw_annotations(study.clips[1], n, SEED, frames=frames)
    annotated = study.pictures.annotations
    skeleton = annotated.skeleton
    states = study.kept("interaction").reshape(-1, skeleton.n_joints, 3)
    rows = []
    for index in range(n):
        keypoints, visible = asked.annotations.keypoints[index], asked.annotations.visible[index]
        truth = whole.annotations.keypoints[index]
        view = asked.views[index]
        lifted = lift_people(keypoints, visible, study.seed_pose, skeleton, view)
        picture = project_to_views(lifted[None], view[None], skeleton)[0, 0]
        seed = project_to_views(study.seed_pose[None], view[None], skeleton)[0, 0]
        for name, positions in {
            "draws": complete_keypoints(keypoints, visible, states, skeleton).positions,
            "nearest annotation": nearest_annotation_completion(
                keypoints, visible, annotated.keypoints, skeleton
            ).positions,
            "single-pose lifting": np.asarray(align_rigidly(picture, keypoints, visible)),
            "the seed": np.asarray(align_rigidly(seed, keypoints, visible)),
        }.items():
            error = hidden_joint_error(truth, positions, ~visible)
            rows.append({"method": name, "pair": index, "error": error})
    return pd.DataFrame(rows)


def summary(draws: MotionDraws) -> dict[str, float]:
    """Return acceptance, the steps' scale, and the seconds of a run."""
    scale = draws.state.get("proposal_log_scale", np.array([np.nan]))
    found = chain_diagnostics(draws)
    return {
        "acceptance": found["acceptance"],
        "scale": float(np.exp(scale).mean()),
        "ess": found["ess_bulk"],
        "seconds": draws.seconds,
    }


def coverage_rows(study: Study, draws: MotionDraws, **labels: object) -> pd.DataFrame:
    """Return one row per measure and chain of a run."""
    table = pd.DataFrame(study.covered(draws), columns=["measure", "chain", "draws", "coverage"])
    return table.assign(**labels, **summary(draws))


def early(draws: MotionDraws) -> list[int]:
    """Return the draws that the paper shows, or as many as there are."""
    last = draws.positions.sizes["draw"] - 1
    return [min(number, last) for number in (200, 400, 600, 800)]


PARTS: dict[str, Callable[[Study], pd.DataFrame]] = {
    "noise": noise,
    "calibration": calibration,
    "truncation": truncation,
    "velocity": velocity,
    "coverage": densities,
    "embedding": embedding,
    "completion": completion,
}


def shown(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """Return what is printed of a part: means over chains and pairs."""
    keys = [k for k in ("density", "proposal", "noise", "limit", "draws") if k in table]
    if name == "completion":
        return table.groupby("method")["error"].agg(["mean", "median", "sem"]).round(4)
    if "measure" not in table:
        return table if name == "calibration" else table.groupby("kind").size().to_frame("poses")
    others = [
        c for c in ("acceptance", "scale", "ess", "seconds", "at_cap", "near_floor") if c in table
    ]
    wide = table.pivot_table(index=keys, columns="measure", values="coverage", sort=False)
    if others:
        wide = wide.join(table.groupby(keys)[others].mean())
    return wide.round(4)


def main() -> None:
    """Run the parts that are not there yet; print every table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("pose-pairs"))
    parser.add_argument("--parts", nargs="*", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="made dances, few draws")
    parser.add_argument("--steps", type=int, default=None, help="draws of a chain")
    parser.add_argument("--chains", type=int, default=4)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    study = Study(
        options.out,
        options.quick,
        steps=options.steps or (1000 if options.quick else 100_000),
        chains=options.chains,
        warmup=300 if options.quick else 3000,
        n_annotations=300 if options.quick else 6000,
        n_held_out=40 if options.quick else 300,
    )
    for name in options.parts:
        path = options.out / f"{name}.csv"
        start = time.perf_counter()
        if not path.exists():
            table = PARTS[name](study)
            with written_whole(path) as unfinished:
                table.to_csv(unfinished, index=False)
        table = pd.read_csv(path)
        print(f"\n{name} ({time.perf_counter() - start:.0f} s)\n{shown(name, table).to_string()}")


if __name__ == "__main__":
    main()

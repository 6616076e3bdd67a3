"""Ablations of pose-pair sampling on the salsa clips: Yin et al. (2018), section 6, figures 6 to 9.

    python notebooks/ablations/pose_pairs.py --out pose-pairs
    python notebooks/ablations/pose_pairs.py --quick --out quick     (made dances, minutes)

Parts: noise, calibration, paired, truncation, velocity, coverage, embedding, completion;
``--parts`` chooses. Each leaves a CSV file and pictures in ``--out``. A run that has left its file
in ``--out/runs`` is not made again, so that what is interrupted goes on.
Real data are looked for as in :func:`probmotion.data.downloads.salsa_pairs`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
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
from probmotion.interaction.backbones import annotation_views
from probmotion.interaction.completion import (
    complete_keypoints,
    hidden_joint_error,
    nearest_annotation_completion,
)
from probmotion.interaction.coordinates import align_rigidly
from probmotion.interaction.pose_distances import MEASURES, pose_distances
from probmotion.interaction.retrieval import views_around
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
# σ_l of the part "coverage", from the part "noise" on the validation clips: for the others where
# they cover best, for interaction coordinates the middle one of their three best.
VALIDATION = ("cmu_60_61_02", "cmu_60_61_10")
NOISE = {"interaction": 0.005, "cartesian": 0.01, "shape-context": 0.005}


@dataclass(frozen=True)
class Study:
    """The data, and how much to draw."""

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
        """Clips that are shown, and clips that are held out whole.

        What is chosen is chosen on clips that are held out of those that are shown.
        """
        if self.quick:
            shown, hidden = hold_out(make_dances(8), ["dance-6", "dance-7"])
        else:
            shown, hidden = hold_out(salsa_pairs(), SALSA_HELD_OUT)
        if self.validating:
            return hold_out(shown, ["dance-5"] if self.quick else VALIDATION)
        return shown, hidden

    @cached_property
    def held_in(self) -> np.ndarray:
        """All frames of the dance of the clips that are shown, (n, J, 3)."""
        return ground_truth(self.clips[0])[0]

    @cached_property
    def held_out(self) -> np.ndarray:
        """Pose-pairs to cover, (G, J, 3)."""
        return ground_truth(self.clips[1], self.n_held_out)[0]

    @cached_property
    def seed_pose(self) -> np.ndarray:
        """The one 3D pose-pair, (J, 3)."""
        return self.held_in[choose_seed(self.held_in)]

    def pictures(self, repeat: int) -> DrawnAnnotations:
        """Frames that are annotated in 2D, and the truth behind them: others in every repeat."""
        frames = [dance_frames(clip) for clip in self.clips[0]]
        n = min(self.n_annotations, sum(int(some.sum()) for some in frames))
        return draw_annotations(self.clips[0], n, repeat, frames=frames)

    def posterior(self, density: str, repeat: int = 0, **changes: object) -> TruncatedPosterior:
        """Return the posterior over a density: a measure's name, or ``"prior"``."""
        if density == "prior":
            return pair_posterior(self.seed_pose, None, replace(PairSettings(), **changes))
        settings = replace(PairSettings(measure=density, noise=NOISE[density]), **changes)
        pictures = self.pictures(repeat).annotations
        return pair_posterior(self.seed_pose, pictures, settings, view_seed=repeat)

    def run(
        self,
        posterior: TruncatedPosterior,
        repeat: int = 0,
        proposal: Proposal | None = None,
        draws: int = 0,
    ) -> MotionDraws:
        """Return every state after the warm-up of chains that start at the seed, side by side."""
        sampler = MetropolisHastings(proposal or Isotropic(0.02), warmup=self.warmup, thin=1)
        return sampler.sample(
            posterior,
            draws=(draws or self.draws) // self.chains,
            chains=self.chains,
            seed=repeat,
            progress=False,
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
        path = self.out / f"poses-{name}.npz"
        if not path.exists():
            raise SystemExit(f"{path} is missing: run the part that makes it, coverage, first")
        with np.load(path) as archive:
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

    def covered(self, draws: MotionDraws, counts: list[int] | None = None) -> pd.DataFrame:
        """Return coverage by the first so many draws of all chains, step by step."""
        poses = step_by_step(draws)
        counts = counts or [len(poses)]
        rows = [
            {"measure": measure, "draws": count, "coverage": value}
            for measure in MEASURES
            for count, value in zip(
                counts, coverage(self.held_out, poses, measure, counts), strict=True
            )
        ]
        return pd.DataFrame(rows)


def step_by_step(draws: MotionDraws) -> np.ndarray:
    """Return the poses of all chains, first step first: (chains × draws, J, 3)."""
    poses = np.swapaxes(draws.positions.values[:, :, 0], 0, 1)
    return poses.reshape(-1, *poses.shape[2:])


def levels(posterior: TruncatedPosterior, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return log prior, log likelihood and their sum of poses, (n, J, 3)."""
    motions = poses[:, None]
    prior = posterior.prior.log_plausibility(motions)
    likelihood = posterior.likelihood.log_density(motions)
    return {"log prior": prior, "log likelihood": likelihood, "log posterior": prior + likelihood}


def calibration(study: Study) -> pd.DataFrame:
    """What the density says of real pairs, of the seed and of draws, at several σ_l."""
    rng = seeds.generator(SEED, "calibration")
    real = study.held_in[rng.choice(len(study.held_in), min(400, len(study.held_in)), False)]
    rows = []
    for size in (0.005, PairSettings().noise, 0.02):
        posterior = study.posterior("interaction", noise=size)
        drawn = step_by_step(study.run(posterior, draws=study.draws // 10))
        found = {
            "real pairs": levels(posterior, real),
            "draws": levels(posterior, drawn[:: max(1, len(drawn) // 400)]),
            "seed": levels(posterior, study.seed_pose[None]),
        }
        if size == PairSettings().noise:
            draw_calibration(found, study.out / "calibration.png")
        rows += [
            (size, kind, part, *np.percentile(values, [10, 50, 90]).round(1))
            for kind, parts in found.items()
            for part, values in parts.items()
        ]
    return pd.DataFrame(rows, columns=["noise", "of", "part", "10 %", "median", "90 %"])


def noise(study: Study) -> pd.DataFrame:
    """σ_l: acceptance, step and coverage of the validation clips; defaults are chosen from it."""
    study = replace(study, validating=True)
    scales = {
        "interaction": (0.003, 0.005, 0.01, 0.02, 0.05),
        "cartesian": (0.0025, 0.005, 0.01, 0.02),
        "shape-context": (0.005, 0.01, 0.02),
    }

    def run(density: str, size: float, repeat: int) -> pd.DataFrame:
        posterior = study.posterior(density, repeat, noise=size)
        draws = study.run(posterior, repeat, draws=study.draws // 10)
        return study.covered(draws).assign(density=density, noise=size, **summary(draws))

    return pd.concat(
        study.once(f"noise-{density}-{size}-{repeat}", partial(run, density, size, repeat))
        for repeat in range(study.repeats)
        for density, sizes in scales.items()
        for size in sizes
    )


def paired(study: Study) -> pd.DataFrame:
    """Interaction against Cartesian coordinates at the same σ_l, annotations, views and seeds."""

    def run(density: str, size: float, repeat: int) -> pd.DataFrame:
        posterior = study.posterior(density, repeat, noise=size)
        draws = study.run(posterior, repeat, draws=study.draws // 10)
        found = study.covered(draws).assign(density=density, noise=size, repeat=repeat)
        return found.assign(**summary(draws))

    return pd.concat(
        study.once(f"paired-{density}-{size}-{repeat}", partial(run, density, size, repeat))
        for repeat in range(study.repeats)
        for size in (0.005, 0.01)
        for density in ("interaction", "cartesian")
    )


def truncation(study: Study) -> pd.DataFrame:
    """c of eq. 11: shares of draws where the density is cut, and coverage."""

    def run(limit: float, repeat: int) -> pd.DataFrame:
        posterior = study.posterior("interaction", repeat, limit=limit)
        draws = study.run(posterior, repeat, draws=study.draws // 10)
        shares = {name: float(draws.dataset[name].mean()) for name in ("at_cap", "near_floor")}
        return study.covered(draws).assign(limit=limit, **shares, **summary(draws))

    return pd.concat(
        study.once(f"truncation-{limit:.3g}-{repeat}", partial(run, limit, repeat))
        for repeat in range(study.repeats)
        for limit in (100.0, limit_for_dimension(108), np.inf)
    )


def velocity(study: Study) -> pd.DataFrame:
    """Biased against unbiased proposals at the same acceptance and number of draws (figure 7)."""
    proposals = {
        "isotropic": Isotropic(0.02),
        "biased-1": VelocityBiased(base=0.02, bias=1.0),
        "biased-10": VelocityBiased(base=0.02, bias=10.0),
        "velocity-alone": VelocityBiased(base=0.001, bias=1.0),
    }

    def run(name: str, repeat: int) -> pd.DataFrame:
        posterior = study.posterior("interaction", repeat)
        draws = study.run(posterior, repeat, proposals[name], draws=study.draws // 10)
        study.keep(f"{name}-{repeat}", early(study, draws))
        return study.covered(draws).assign(proposal=name, **summary(draws))

    table = pd.concat(
        study.once(f"velocity-{name}-{repeat}", partial(run, name, repeat))
        for repeat in range(study.repeats)
        for name in proposals
    )
    draw_pairs(
        {"unbiased": study.kept("isotropic-0"), "velocity-\nbiased": study.kept("biased-1-0")},
        study.posterior("prior").skeleton,
        study.out / "figure7.png",
        columns=4,
        title="states 200, 400, 600 and 800 of a chain, by proposal",
    )
    return table


def densities(study: Study) -> pd.DataFrame:
    """Coverage against the number of draws, four densities, three dissimilarities (figure 9)."""
    counts = [study.draws // 100, study.draws // 10, study.draws]

    def run(density: str, repeat: int) -> pd.DataFrame:
        draws = study.run(study.posterior(density, repeat), repeat)
        poses = step_by_step(draws)
        study.keep(f"{density}-{repeat}", poses[:: max(1, len(poses) // 10_000)])
        study.keep(f"{density}-early-{repeat}", early(study, draws))
        return study.covered(draws, counts).assign(density=density, **summary(draws))

    table = pd.concat(
        study.once(f"coverage-{density}-{repeat}", partial(run, density, repeat))
        for density in ("interaction", "cartesian", "prior", "shape-context")
        # Shape contexts cost several times as much, and are drawn once.
        for repeat in range(1 if density == "shape-context" else study.repeats)
    )
    draw_coverage(table, study.out / "figure9.png")
    draw_pairs(
        {
            "prior alone": study.kept("prior-early-0"),
            "prior and\nlikelihood": study.kept("interaction-early-0"),
        },
        study.posterior("prior").skeleton,
        study.out / "figure6.png",
        columns=4,
        title="states 200, 400, 600 and 800 of a chain, by density",
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
            ("all held-in real pairs", study.held_in),
        )
        for measure in MEASURES
    ]
    return pd.concat([table, pd.DataFrame(rows)])


def embedding(study: Study) -> pd.DataFrame:
    """Draws over the space of the real pairs, by multidimensional scaling (figure 8)."""
    sets = {"real": study.held_out[:: max(1, len(study.held_out) // 150)]}
    for kind, density in (("prior", "prior"), ("posterior", "interaction")):
        # Of two thousand draws evenly apart some of the first 20, of the first 200 and of all.
        states = study.kept(f"{density}-0")
        states = states[:: max(1, len(states) // 2000)]
        sets[kind] = np.concatenate([states[:20:2], states[20:200:4], states[200::18]])
    sets["seed"] = study.seed_pose[None]
    poses = np.concatenate(list(sets.values()))
    kinds = [kind for kind, some in sets.items() for _ in some]
    points = classical_scaling(pose_distances(poses, poses, "interaction"))
    parts = {f"{study.draws // 100} draws": 10, f"{study.draws // 10} draws": 55}
    counts = parts | {f"{study.draws} draws": len(sets["prior"])}
    draw_embedding(points, kinds, study.out / "figure8.png", counts=counts)
    return pd.DataFrame({"kind": kinds, "x": points[:, 0], "y": points[:, 1]})


def completion(study: Study) -> pd.DataFrame:
    """Hidden joints of held-out pairs: error beside the two baselines, in the picture, metres.

    Every method gets the same estimate of the view, from the seed's torsos.
    """
    frames = [dance_frames(clip) for clip in study.clips[1]]
    n = 10 if study.quick else 60
    asked = draw_annotations(study.clips[1], n, SEED, frames=frames, hidden=0.3)
    whole = draw_annotations(study.clips[1], n, SEED, frames=frames)
    annotated = study.pictures(0).annotations
    skeleton = annotated.skeleton
    views = annotation_views(asked.annotations, study.seed_pose)
    states = study.kept("interaction-0")
    rows = []
    for index in range(n):
        keypoints, visible = asked.annotations.keypoints[index], asked.annotations.visible[index]
        truth = whole.annotations.keypoints[index]
        view = views[index]
        if np.isnan(view).any():  # too little of a torso is seen
            continue
        lifted = lift_people(keypoints, visible, study.seed_pose, skeleton, view)
        seed = project_to_views(study.seed_pose[None], view[None], skeleton)[0, 0]
        for name, positions in {
            "draws": complete_keypoints(
                keypoints, visible, states, skeleton, views=views_around(view)
            ).positions,
            "nearest annotation": nearest_annotation_completion(
                keypoints, visible, annotated.keypoints, skeleton
            ).positions,
            "single-pose lifting": lifted[:, :2],
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


def early(study: Study, draws: MotionDraws) -> np.ndarray:
    """Return the states that the paper shows of the first chain, turned to the seed, (4, J, 3)."""
    last = draws.positions.sizes["draw"] - 1
    chosen = [min(number, last) for number in (200, 400, 600, 800)]
    poses = draws.positions.values[0, chosen, 0]
    return align_rigidly(poses, np.broadcast_to(study.seed_pose, poses.shape))


PARTS: dict[str, Callable[[Study], pd.DataFrame]] = {
    "noise": noise,
    "calibration": calibration,
    "paired": paired,
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


def same_study(study: Study) -> None:
    """Stop where the folder holds runs of another study, which would be taken for this one's."""
    about = {k: v for k, v in asdict(study).items() if k not in ("out", "repeats", "validating")}
    about |= {"noise": NOISE, "version": version("probmotion")}
    path = study.out / "study.json"
    if path.exists() and json.loads(path.read_text()) != about:
        raise SystemExit(f"{path} is of another study, expected {about}: choose another --out")
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(about))


def main() -> None:
    """Run the parts that are not there yet; print every table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("pose-pairs"))
    parser.add_argument("--parts", nargs="*", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="made dances, few draws")
    parser.add_argument("--draws", type=int, help="of all chains; 100000 by default")
    parser.add_argument("--repeats", type=int, default=3, help="with other annotations each")
    options = parser.parse_args()
    if options.repeats < 1 or (options.draws is not None and options.draws < 400):
        parser.error("expected --repeats of at least 1 and --draws of at least 400")
    options.out.mkdir(parents=True, exist_ok=True)
    study = Study(
        options.out,
        options.quick,
        draws=options.draws or (4000 if options.quick else 100_000),
        chains=4,
        warmup=300 if options.quick else 3000,
        repeats=options.repeats,
        n_annotations=300 if options.quick else 6000,
        n_held_out=40 if options.quick else 300,
    )
    same_study(study)
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

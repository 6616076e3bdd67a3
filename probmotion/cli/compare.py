"""The command ``probmotion compare``: comparison of samplers on problems."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from probmotion.cli.files import Conventions, file_called

if TYPE_CHECKING:
    from probmotion.posteriors.problem import Problem

__all__ = ["Clips", "Compare"]


@dataclass(frozen=True)
class Clips(Conventions):
    """User-supplied clips; one clip is held out and observed."""

    clips: Annotated[tuple[str, ...], arg(metavar="FILE ...", help_behavior_hint="")] = ()
    """Motion files (.npz, .bvh) or quoted patterns.
    The prior is fitted to all clips except the held-out one."""

    observe: str = "monocular"
    """Observations of the held-out clip: monocular, occluded, sparse or none."""

    fps: Annotated[float | None, arg(metavar="FPS", help_behavior_hint="")] = None
    """Frame rate to resample the clips to, frames per second; required if their rates differ."""

    frames: int = 30
    """Number of frames per motion."""

    rank: int = 10
    """Number of latent dimensions per style."""

    styles: int = 3
    """Number of styles, assigned by clustering."""

    noise: float = 0.02
    """Standard deviation of the observed keypoints, metres."""

    held_out: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Name of the held-out clip (file name without extension); the last clip by default."""


@dataclass(frozen=True)
class Compare:
    """Run samplers on the same posteriors and print which are right.

    Finished runs are stored in --out: run the command again to resume it, with others to extend it.

    Settings of samplers: --settings.SAMPLER.NAME VALUE; probmotion show SAMPLER lists them.
    """

    problems: Annotated[
        Positional[tuple[str, ...]], arg(metavar="[PROBLEM ...]", help_behavior_hint="")
    ] = ()
    """Names of problems (see probmotion list), or all for every problem with available data."""

    samplers: Annotated[tuple[str, ...], arg(metavar="SAMPLER ...", help_behavior_hint="")] = ()
    """Names of samplers or presets (see probmotion list); all samplers by default."""

    draws: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Number of posterior draws per sampler. Default: 200."""

    chains: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Number of chains; by default the largest divisor of the draws up to 4."""

    seeds: int = 1
    """Number of independent repetitions, with seeds 0, 1, …"""

    workers: int = 1
    """Number of worker processes; 0 runs in this process. Draws do not depend on the number."""

    out: Path = Path("comparison")
    """Output folder for all draws and their metrics: table.txt, table.csv."""

    quick: FlagCreatePairsOff[bool] = False
    """Quick run: 6 s per run, 60 s limit, reduced settings; other options override."""

    evaluations: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Budget per run: evaluations of the density or denoiser; a gradient counts as two.
    Pilot runs choose matching settings. No budget by default."""

    seconds: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None
    """Budget per run, seconds on this machine. Default: none; 6 with --quick."""

    time_limit: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None
    """Time limit per run, seconds; longer runs fail. Default: none; 60 with --quick."""

    calibrate: int = 0
    """Number of simulations for simulation-based calibration, at least 10; 0 for none.
    Each simulation costs as much as a run."""

    report: FlagCreatePairsOff[bool] = False
    """Also write report.html with the table, plots and animated draws."""

    figures: FlagCreatePairsOff[bool] = False
    """Also write figures, as .png and .pdf: skeletons_PROBLEM, spread_PROBLEM (of observed motion)
    and, where quality is measured, quality_against_cost."""

    prior: Annotated[str | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Also sample a user-trained prior: the folder of a run of probmotion train diffusion or dvae.
    The prior is sampled without observations; errors require exact draws of the prior."""

    user_clips: OmitArgPrefixes[Clips] = field(default_factory=Clips)

    settings: ClassVar[Any] = None
    """Settings of the samplers; main.py adds the field."""

    def run(self) -> None:
        from probmotion.comparison.grid import compare

        samplers = self._samplers()
        problems = self._problems()
        self._check_calibrate(problems)
        options = self._options()
        comparison = compare(problems, samplers, seeds=self.seeds, **options)
        print(comparison.summary())
        print(f"\nmetrics: {self.out / 'table.txt'}, {self.out / 'table.csv'}")
        calibration = self._calibration(problems, samplers, options) if self.calibrate else None
        if self.report:
            print(f"report: {comparison.report(self.out / 'report.html', calibration)}")
        if self.figures:
            from probmotion.comparison.figures import draw_comparison

            draw_comparison(comparison, problems, self.out)
            print(f"figures: {self.out / '*.pdf'}")

    def _options(self) -> dict[str, Any]:
        """Return the options shared by comparison and calibration."""
        from probmotion.comparison.quick import QUICK_BUDGET, QUICK_DRAWS, QUICK_LIMIT
        from probmotion.comparison.results.budgets import Budget

        draws, budget, limit = (
            (QUICK_DRAWS, QUICK_BUDGET, QUICK_LIMIT) if self.quick else (200, None, None)
        )
        if self.evaluations is not None or self.seconds is not None:
            budget = Budget(evaluations=self.evaluations, seconds=self.seconds)
        draws = draws if self.draws is None else self.draws
        divisor = max(n for n in (1, 2, 3, 4) if draws % n == 0)
        return {
            "draws": draws,
            "chains": divisor if self.chains is None else self.chains,
            "workers": self.workers,
            "out": self.out,
            "budget": budget,
            "time_limit": limit if self.time_limit is None else self.time_limit,
        }

    def _calibration(
        self, problems: list[Problem], samplers: dict[str, Any], options: dict[str, Any]
    ) -> Any:
        from probmotion.calibration.grid import calibrate

        simulated = [problem for problem in problems if problem.simulate is not None]
        for problem in problems:
            if problem.simulate is None:
                print(f"not calibrated, cannot be simulated: {problem.name}")
        calibration = calibrate(simulated, samplers, simulations=self.calibrate, **options)
        for problem in simulated:
            for sampler in samplers:
                print(calibration.verdict(problem.name, sampler))
        return calibration

    def _check_calibrate(self, problems: list[Problem]) -> None:
        """Validate ``calibrate`` before the comparison starts."""
        from probmotion.calibration.grid import FEWEST_SIMULATIONS as FEWEST

        if self.calibrate and self.calibrate < FEWEST:
            raise ValueError(f"calibrate must be at least {FEWEST}, got {self.calibrate}")
        if self.calibrate and all(problem.simulate is None for problem in problems):
            raise ValueError("calibrate requires a problem that can be simulated, got none")

    def _samplers(self) -> dict[str, Any]:
        from probmotion.cli.settings_options import sampler_called
        from probmotion.posteriors.sampling import importable_samplers

        names = self.samplers or tuple(importable_samplers())
        if len(set(names)) < len(names):
            raise ValueError(f"samplers must be unique, got {' '.join(names)}")
        return {name: sampler_called(name, self.settings) for name in names}

    def _problems(self) -> list[Problem]:
        from probmotion.problems.catalogue import load_problem

        if not self.problems and not self.user_clips.clips and self.prior is None:
            raise ValueError(
                "problems must not be empty: name problems (see probmotion list) or all, or pass "
                "--clips FILE… or --prior FOLDER"
            )
        if not self.user_clips.clips and self.user_clips != Clips():
            names = [entry.name for entry in fields(Clips)]
            changed = [n for n in names if getattr(self.user_clips, n) != getattr(Clips(), n)]
            raise ValueError(f"{', '.join(changed)} requires --clips FILE…")
        problems = [load_problem(name) for name in self._names()]
        if self.user_clips.clips:
            problems.append(_problem_of_clips(self.user_clips))
        if self.prior is not None:
            problems.append(_problem_of_prior(self.prior))
        return problems

    def _names(self) -> tuple[str, ...]:
        from probmotion.problems.catalogue import available_problems

        if "all" not in self.problems:
            return self.problems
        if len(self.problems) > 1:
            raise ValueError(f"problems must be names or all, got {' '.join(self.problems)}")
        available, skipped = available_problems()
        for name, reason in skipped.items():
            print(f"skipped: {name}: {reason}")
        return tuple(available)


def _problem_of_clips(user_clips: Clips) -> Problem:
    from probmotion.io.files import load_all
    from probmotion.problems.clips import clips_problem

    options = asdict(user_clips)
    conventions = {name: options.pop(name) for name in user_clips.conventions()}
    clips = load_all(options.pop("clips"), **conventions)
    held_out = options.pop("held_out")
    return clips_problem(clips, held_out=-1 if held_out is None else held_out, **options)


def _problem_of_prior(source: str) -> Problem:
    """Return the problem of sampling a user-trained prior, named after its folder."""
    from probmotion.cli.summaries import kind_of_network
    from probmotion.models.diffusion import motion_diffusion
    from probmotion.models.dvae import motion_dvae
    from probmotion.posteriors.posterior import MotionPosterior
    from probmotion.posteriors.problem import Problem

    known: dict[str, Any] = {
        motion_diffusion.KIND: motion_diffusion.MotionDiffusion,
        motion_dvae.KIND: motion_dvae.MotionDVAE,
    }
    kind = kind_of_network(file_called(Path(source)))
    if kind not in known:
        raise ValueError(f"prior must be a {' or a '.join(known)}, got a {kind} in {source}")
    posterior = MotionPosterior(known[kind].load(source))
    path = Path(source).resolve()
    name = path.parent.name if path.name == "model.safetensors" else path.name
    name = name.removesuffix(".safetensors")
    return Problem(name, "user-trained prior: generation", posterior)

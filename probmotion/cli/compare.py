"""The command ``probmotion compare``: samplers on problems, of the library or of one's own.

It is a dataclass whose fields are its options, as in :mod:`probmotion.cli`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from tyro.conf import OmitArgPrefixes, Positional

from probmotion.cli.files import file_called

if TYPE_CHECKING:
    from probmotion.posteriors.problem import Problem

__all__ = ["Clips", "Compare"]


@dataclass(frozen=True)
class Clips:
    """Clips of your own to compare on, and what is seen of the one that is held out."""

    clips: tuple[str, ...] = ()
    """Motion files, .npz or .bvh, or quoted patterns of them: the prior is fitted to all but one,
    and the evidence is of that one."""

    observe: str = "monocular"
    """What is seen of the held-out clip: monocular, occluded, sparse or none."""

    fps: float | None = None
    """Resample every clip to this frame rate; needed where their own rates differ."""

    frames: int = 30
    """Frames per motion."""

    rank: int = 10
    """Latent dimensions of each style."""

    styles: int = 3
    """Number of styles, found by clustering."""

    noise: float = 0.02
    """Standard deviation of the keypoints, metres."""

    held_out: str | None = None
    """Name of the clip to hold out (its file's name without the ending); the last by default."""


@dataclass(frozen=True)
class Compare:
    """Draw with several samplers from the same posteriors; print how far each of them is off.

    The folder --out keeps every finished cell (problem, sampler, seed): the same command run again
    goes on where it was stopped.
    """

    problems: Positional[tuple[str, ...]] = ()
    """Names of problems (see probmotion list); all: every one whose data is at hand."""

    samplers: tuple[str, ...] = ()
    """Names of samplers or their presets (see probmotion list); all samplers by default."""

    draws: int | None = None
    """Draws of each sampler in all; 200, or 40 with --quick."""

    chains: int | None = None
    """Chains that they are spread over; by default the most, up to 4, that divide the draws."""

    seeds: int = 1
    """Independent repeats, with seeds 0, 1, …"""

    workers: int = 1
    """Processes; they never change the draws. 0: in this one."""

    out: Path = Path("comparison")
    """Folder for table.csv and all draws; made where it is missing."""

    quick: bool = False
    """A look: 40 draws, six seconds a cell, ended after a minute, unless told otherwise, and
    settings to begin from that cost less; the table says so."""

    evaluations: int | None = None
    """What every sampler may spend on a cell: evaluations of a density or a denoiser, a gradient
    counting as two. Pilot runs find the settings that do. By default samplers run as they are."""

    seconds: float | None = None
    """The same in seconds of this machine; 6 with --quick."""

    time_limit: float | None = None
    """Seconds after which a cell is ended, and a row that says so; 60 with --quick."""

    calibrate: int = 0
    """Also simulate every problem that can be so many times, and rank the truth among each
    sampler's draws. A simulation costs each sampler as much as a cell."""

    report: bool = False
    """Also write report.html: the table, the plots, and draws that play in a browser."""

    pictures: bool = False
    """Also write one picture of skeletons per problem and, where quality can be measured,
    quality_against_cost.png."""

    prior: str | None = None
    """Also draw from a prior of your own: the folder of a run of probmotion train diffusion or
    dvae. There is no evidence. Draws are compared with the prior's own where it can be drawn from;
    else there is nothing to measure them by but what they cost."""

    own: OmitArgPrefixes[Clips] = field(default_factory=Clips)

    settings: ClassVar[Any] = None
    """The samplers' settings: a field of the class that the command line makes of this one."""

    def run(self) -> None:
        """Run the comparison, write ``table.csv``, print the table."""
        from probmotion.comparison.grid import compare

        samplers = self._samplers()
        problems = self._problems()
        self._check_calibrate(problems)
        asked = self._asked()
        comparison = compare(problems, samplers, seeds=self.seeds, **asked)
        comparison.write(self.out)
        print(comparison.table())
        print(f"\ntable and draws are in {self.out}")
        calibration = self._calibration(problems, samplers, asked) if self.calibrate else None
        if self.report:
            print(f"wrote {comparison.report(self.out / 'report.html', calibration)}")
        if self.pictures:
            from probmotion.comparison.figures import draw_comparison

            draw_comparison(comparison, problems, self.out)

    def _asked(self) -> dict[str, Any]:
        """Return what cells are given, of a comparison and of a calibration."""
        from probmotion.comparison.quick import QUICK_BUDGET, QUICK_DRAWS, QUICK_LIMIT
        from probmotion.comparison.results.budgets import Budget

        usual = (QUICK_DRAWS, QUICK_BUDGET, QUICK_LIMIT) if self.quick else (200, None, None)
        draws, budget, limit = usual
        if self.draws is not None:
            draws = self.draws
        if self.evaluations is not None or self.seconds is not None:
            budget = Budget(evaluations=self.evaluations, seconds=self.seconds)
        if self.time_limit is not None:
            limit = self.time_limit
        fitting = max(n for n in (1, 2, 3, 4) if draws % n == 0)
        return {
            "draws": draws,
            "chains": fitting if self.chains is None else self.chains,
            "workers": self.workers,
            "out": self.out,
            "budget": budget,
            "time_limit": limit,
        }

    def _calibration(
        self, problems: list[Problem], samplers: dict[str, Any], asked: dict[str, Any]
    ) -> Any:
        from probmotion.calibration.grid import calibrate

        simulated = [problem for problem in problems if problem.simulate is not None]
        for problem in problems:
            if problem.simulate is None:
                print(f"{problem.name} cannot be simulated: it is not calibrated")
        found = calibrate(simulated, samplers, simulations=self.calibrate, **asked)
        for problem in simulated:
            for sampler in samplers:
                print(found.verdict(problem.name, sampler))
        return found

    def _check_calibrate(self, problems: list[Problem]) -> None:
        """Refuse what would fail after the comparison has run."""
        from probmotion.calibration.grid import FEWEST_SIMULATIONS

        if not self.calibrate:
            return
        if self.calibrate < FEWEST_SIMULATIONS:
            raise ValueError(
                f"calibrate must be {FEWEST_SIMULATIONS} simulations or more, got {self.calibrate}"
            )
        if all(problem.simulate is None for problem in problems):
            raise ValueError("calibrate is given, but none of the problems can be simulated")

    def _samplers(self) -> dict[str, Any]:
        from probmotion.cli.settings_options import sampler_called
        from probmotion.posteriors.sampling import importable_samplers

        names = self.samplers or tuple(importable_samplers())
        if len(set(names)) < len(names):
            raise ValueError(f"samplers must be each once, got {' '.join(names)}")
        return {name: sampler_called(name, self.settings) for name in names}

    def _problems(self) -> list[Problem]:
        from probmotion.problems.catalogue import load_problem

        if not self.problems and not self.own.clips and self.prior is None:
            raise ValueError(
                "no problem is given, expected names of problems (probmotion list shows them), "
                "all, clips of your own (--clips FILE…) or a prior of your own (--prior FOLDER)"
            )
        if not self.own.clips and self.own != Clips():
            changed = [entry.name for entry in fields(Clips) if self._differs(entry.name)]
            raise ValueError(
                f"{', '.join(changed)} is given without clips, expected --clips FILE… beside it"
            )
        problems = [load_problem(name) for name in self._names()]
        if self.own.clips:
            problems.append(_problem_of_clips(self.own))
        if self.prior is not None:
            problems.append(_problem_of_prior(self.prior))
        return problems

    def _names(self) -> tuple[str, ...]:
        from probmotion.problems.catalogue import problems_at_hand

        if "all" not in self.problems:
            return self.problems
        if len(self.problems) > 1:
            raise ValueError(f"problems must be all, or some names, got {' '.join(self.problems)}")
        found, left_out = problems_at_hand()
        for name, reason in left_out.items():
            print(f"left out: {name}: {reason}")
        return tuple(found)

    def _differs(self, option: str) -> bool:
        return getattr(self.own, option) != getattr(Clips(), option)


def _problem_of_clips(own: Clips) -> Problem:
    """Return the problem that a user's clips make."""
    from probmotion.io.files import load_motions
    from probmotion.problems.clips import clips_problem

    return clips_problem(
        load_motions(own.clips),
        observe=own.observe,
        fps=own.fps,
        frames=own.frames,
        rank=own.rank,
        styles=own.styles,
        noise=own.noise,
        held_out=-1 if own.held_out is None else own.held_out,
    )


def _problem_of_prior(source: str) -> Problem:
    """Return the problem to draw from a prior that a user trained, called as its folder."""
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
        raise ValueError(
            f"prior is {source}, which holds a {kind}, expected a {' or a '.join(known)}"
        )
    posterior = MotionPosterior(known[kind].load(source))
    path = Path(source).resolve()
    name = path.parent.name if path.name == "model.safetensors" else path.name
    name = name.removesuffix(".safetensors")
    return Problem(name, "a prior that was trained on data of one's own: generation", posterior)

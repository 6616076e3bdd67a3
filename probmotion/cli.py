"""The command line: ``probmotion compare | list | show | convert | train``.

Each command is a dataclass whose fields are its options. Libraries are imported by the command
that needs them, so that help and mistakes answer at once.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import OmitArgPrefixes, Positional, arg

from probmotion.reference_commands import Reference

if TYPE_CHECKING:
    from probmotion.motion import Motion
    from probmotion.problems import Problem

__all__ = ["Clips", "Compare", "Convert", "List", "Show", "main"]

_OVERVIEW = """usage: probmotion COMMAND [OPTIONS]

One posterior over 3D motion, many samplers, and how wrong each of them is.

commands:
  compare    draw with several samplers from the same posteriors; print how far each is off
  list       the problems, the samplers and the skeletons that are known by name
  show       say what is in a file of motion, keypoints, draws or a network; draw it
  convert    write a motion to another format, frame rate or skeleton
  train      learn a prior, or what priors are measured with
  reference  make reference draws of a problem, with a certificate of how right they are

probmotion COMMAND --help lists the options of a command."""


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
    """Names of problems (see probmotion list)."""

    samplers: tuple[str, ...] = ()
    """Names of samplers or their presets (see probmotion list); all samplers by default."""

    draws: int = 200
    """Draws of each sampler in all."""

    chains: int | None = None
    """Chains that they are spread over; by default the most, up to 4, that divide the draws."""

    seeds: int = 1
    """Independent repeats, with seeds 0, 1, …"""

    workers: int = 1
    """Processes; they never change the draws."""

    out: Path = Path("comparison")
    """Folder for table.csv and all draws; made where it is missing."""

    quick: bool = False
    """Begin from settings that cost less, as a demonstration wants; the table names them."""

    evaluations: int | None = None
    """What every sampler may spend on a cell: evaluations of a density or a denoiser, a gradient
    counting as two. Pilot runs find the settings that do. By default samplers run as they are."""

    seconds: float | None = None
    """The same in seconds of this machine."""

    time_limit: float | None = None
    """Seconds after which a cell is ended, and a row that says so."""

    calibrate: int = 0
    """Also simulate every problem that can be so many times, and rank the truth among each
    sampler's draws."""

    report: bool = False
    """Also write report.html: the table, the plots, and draws that play in a browser."""

    pictures: bool = False
    """Also write one picture of skeletons per problem and, where quality can be measured,
    quality_against_cost.png."""

    prior: str | None = None
    """Also draw from a prior of your own: the folder of a run of probmotion train diffusion or
    dvae. There is no evidence, and nothing to measure draws by but what they cost; they are in
    --out."""

    own: OmitArgPrefixes[Clips] = field(default_factory=Clips)

    settings: ClassVar[Any] = None
    """The samplers' settings: a field of the class that :func:`_parse` makes of this one."""

    def run(self) -> None:
        """Run the comparison, write ``table.csv``, print the table."""
        from probmotion.comparison import compare

        samplers = self._samplers()
        problems = self._problems()
        fitting = max(n for n in (1, 2, 3, 4) if self.draws % n == 0)
        chains = fitting if self.chains is None else self.chains
        comparison = compare(
            problems,
            samplers,
            draws=self.draws,
            chains=chains,
            seeds=self.seeds,
            workers=self.workers,
            out=self.out,
            budget=self._budget(),
            time_limit=self.time_limit,
        )
        comparison.write(self.out)
        print(comparison.table())
        print(f"\ntable and draws are in {self.out}")
        calibration = self._calibration(problems, samplers, chains) if self.calibrate else None
        if self.report:
            print(f"wrote {comparison.report(self.out / 'report.html', calibration)}")
        if self.pictures:
            from probmotion.pictures.comparisons import draw_comparison

            draw_comparison(comparison, problems, self.out)

    def _budget(self) -> Any:
        from probmotion.comparison import Budget

        if self.evaluations is None and self.seconds is None:
            return None
        return Budget(evaluations=self.evaluations, seconds=self.seconds)

    def _calibration(self, problems: list[Problem], samplers: dict[str, Any], chains: int) -> Any:
        from probmotion.calibration import calibrate

        simulated = [problem for problem in problems if problem.simulate is not None]
        if not simulated:
            raise ValueError("calibrate is given, but none of the problems can be simulated")
        found = calibrate(
            simulated,
            samplers,
            simulations=self.calibrate,
            draws=self.draws,
            chains=chains,
            workers=self.workers,
            out=self.out,
            time_limit=self.time_limit,
        )
        for problem in simulated:
            for sampler in samplers:
                print(found.verdict(problem.name, sampler))
        return found

    def _samplers(self) -> dict[str, Any]:
        from probmotion.sampling import sampler_names
        from probmotion.settings_options import sampler_called

        names = self.samplers or sampler_names()
        return {name: sampler_called(name, self.settings) for name in names}

    def _problems(self) -> list[Problem]:
        from probmotion.problems import load_problem

        if not self.problems and not self.own.clips and self.prior is None:
            raise ValueError(
                "no problem is given, expected names of problems (probmotion list shows them), "
                "clips of your own (--clips FILE…) or a prior of your own (--prior FOLDER)"
            )
        if not self.own.clips and self.own != Clips():
            changed = [entry.name for entry in fields(Clips) if self._differs(entry.name)]
            raise ValueError(
                f"{', '.join(changed)} is given without clips, expected --clips FILE… beside it"
            )
        problems = [load_problem(name) for name in self.problems]
        if self.own.clips:
            problems.append(problem_from(self.own))
        if self.prior is not None:
            problems.append(problem_of_prior(self.prior))
        return problems

    def _differs(self, option: str) -> bool:
        return getattr(self.own, option) != getattr(Clips(), option)


def problem_from(own: Clips) -> Problem:
    """Return the problem that a user's clips make."""
    from probmotion.motion import load_motions
    from probmotion.problems import clips_problem

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


def problem_of_prior(source: str) -> Problem:
    """Return the problem to draw from a prior that a user trained, called as its folder."""
    from probmotion.models import motion_diffusion, motion_dvae
    from probmotion.posterior import MotionPosterior
    from probmotion.problems import Problem
    from probmotion.summaries import kind_of_network

    known: dict[str, Any] = {
        motion_diffusion.KIND: motion_diffusion.MotionDiffusion,
        motion_dvae.KIND: motion_dvae.MotionDVAE,
    }
    kind = kind_of_network(_file_called(Path(source)))
    if kind not in known:
        raise ValueError(
            f"prior is {source}, which holds a {kind}, expected a {' or a '.join(known)}"
        )
    posterior = MotionPosterior(known[kind].load(source))
    path = Path(source).resolve()
    name = path.parent.name if path.name == "model.safetensors" else path.name
    name = name.removesuffix(".safetensors")
    return Problem(name, "a prior that was trained on data of one's own: generation", posterior)


@dataclass(frozen=True)
class List:
    """List the problems, the samplers and the skeletons that are known by name."""

    def run(self) -> None:
        """Print three lists."""
        from probmotion.problems import problem_descriptions
        from probmotion.sampling import load_sampler, sampler_names
        from probmotion.settings_options import presets_of
        from probmotion.skeleton import Skeleton
        from probmotion.skeleton_presets import PRESETS

        _print_list("problems", problem_descriptions())
        kinds = {name: load_sampler(name) for name in sampler_names()}
        _print_list("samplers", {name: _first_line(kind) for name, kind in kinds.items()})
        presets = {
            f"{name}.{preset}": _first_line(getattr(kind, preset))
            for name, kind in kinds.items()
            for preset in presets_of(kind)
        }
        _print_list("presets of samplers", presets)
        skeletons = {name: Skeleton.preset(name) for name in PRESETS}
        _print_list(
            "skeletons",
            {name: f"{skeleton.n_joints} joints" for name, skeleton in skeletons.items()},
        )


def _print_list(title: str, entries: dict[str, str]) -> None:
    width = max(map(len, entries))
    print(f"{title}:")
    for name, words in entries.items():
        print(f"  {name:{width}}  {words}")


def _first_line(kind: Any) -> str:
    return (kind.__doc__ or "").strip().partition("\n")[0]


@dataclass(frozen=True)
class Show:
    """Say what is in a file of motion (.bvh, .npz), keypoints (.json, .npz, .csv), draws (.nc) or
    a trained network (.safetensors)."""

    file: Positional[Path]
    """The file; of a network also the folder of its run, or the name of one in the package."""

    fps: float | None = None
    """Frames per second of keypoints in JSON or a table, which do not hold it."""

    skeleton: str | None = None
    """What keypoints in JSON are of (see probmotion list), where their number does not tell, or
    which joints to take from a table."""

    picture: Path | None = None
    """Also draw the motion, or the first draws, to this .png."""

    def run(self) -> None:
        """Print a few lines about the file."""
        from probmotion.summaries import summarise

        summary = summarise(_file_called(self.file), self.fps, self.skeleton)
        print(summary.text)
        if self.picture is not None:
            summary.draw(self.picture)
            print(f"wrote {self.picture}")


def _file_called(path: Path) -> Path:
    """Return the file of the network that comes with the package, where a path is its name."""
    if path.suffix or path.exists():
        return path
    from probmotion import models

    shipped = Path(models.__file__).parent / "weights" / f"{path}.safetensors"
    return shipped if shipped.is_file() else path


@dataclass(frozen=True)
class Convert:
    """Write a motion to another format, frame rate or skeleton."""

    source: Annotated[Positional[Path], arg(name="IN")]
    """The motion (.bvh, .npz) or draws (.nc)."""

    target: Annotated[Positional[Path], arg(name="OUT")]
    """What to write; the ending chooses the format: .bvh or .npz."""

    fps: float | None = None
    """Resample to this frame rate."""

    skeleton: str | None = None
    """Retarget to this skeleton (see probmotion list)."""

    draw: int | None = None
    """Which draw of the first chain, where IN holds draws; the first by default."""

    def run(self) -> None:
        """Read, change, write."""
        motion = self._read()
        if self.fps is not None:
            motion = motion.resample(self.fps)
        if self.skeleton is not None:
            from probmotion.skeleton import Skeleton

            motion = motion.retarget(Skeleton.preset(self.skeleton))
        motion.save(self.target)
        print(f"wrote {self.target}: {motion}")

    def _read(self) -> Motion:
        from probmotion.draws import MotionDraws
        from probmotion.motion import load_motion

        if self.source.suffix != ".nc":
            if self.draw is not None:
                raise ValueError(f"draw is {self.draw}, but {self.source} holds no draws (.nc)")
            return load_motion(self.source)
        draws = MotionDraws.load(self.source)
        count = draws.dataset.sizes["draw"]
        draw = 0 if self.draw is None else self.draw
        if not 0 <= draw < count:
            raise ValueError(f"draw is {draw}, expected 0 to {count - 1}")
        return draws.motion(draw)


_COMMANDS: dict[str, type[Any]] = {
    "compare": Compare, "list": List, "show": Show, "convert": Convert,
    "reference": Reference,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0, 2 for wrong input, 130 for Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_OVERVIEW)
        return 0 if words else 2
    commands = [*_COMMANDS, "train"]
    if words[0] not in commands:
        return _complain(f"command is {words[0]!r}, expected one of {', '.join(commands)}", 2)
    with warnings.catch_warnings():
        warnings.showwarning = _note
        try:
            _parse(words[0], words[1:]).run()
        except KeyboardInterrupt as error:
            return _complain(str(error) or "interrupted; nothing was written", 130)
        except BrokenPipeError:
            # Whoever read the output has had enough: `probmotion list | head`.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except OSError as error:
            named = error.filename and error.strerror
            return _complain(f"{error.filename}: {error.strerror}" if named else str(error), 2)
        except ValueError as error:
            return _complain(str(error), 2)
        except MemoryError as error:
            return _complain(f"there is not enough memory for this: {error}", 2)
    return 0


def _parse(name: str, words: Sequence[str]) -> Any:
    """Return the command with its options; a wrong option ends the process with status 2."""
    import tyro

    prog = f"probmotion {name}"
    if name == "train":
        from probmotion.training_commands import TRAINABLE

        if words and words[0] in ("-h", "--help"):
            print(f"usage: {prog} KIND [OPTIONS]\n")
            _print_list("kinds", {kind: _first_line(what) for kind, what in TRAINABLE.items()})
            print(f"\n{prog} KIND --help lists the options of a kind.")
            raise SystemExit(0)
        known = ", ".join(TRAINABLE)
        if not words or words[0] not in TRAINABLE:
            got = repr(words[0]) if words else "missing"
            raise ValueError(f"what to train is {got}, expected one of {known}")
        return tyro.cli(TRAINABLE[words[0]], prog=f"{prog} {words[0]}", args=words[1:])
    kind = _COMMANDS[name]
    if kind is not Compare:
        return tyro.cli(kind, prog=prog, args=words)
    from probmotion.settings_options import objects_as_words, settings_of_samplers

    settings = settings_of_samplers(quick="--quick" in words)
    entry = ("settings", settings, field(default_factory=settings))
    with_settings = make_dataclass("Compare", [entry], bases=(Compare,), frozen=True)
    with_settings.__doc__ = Compare.__doc__
    return tyro.cli(with_settings, prog=prog, args=words, registry=objects_as_words())


def _note(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"probmotion: note: {message}", file=sys.stderr)


def _complain(sentence: str, status: int) -> int:
    print(f"probmotion: {sentence}", file=sys.stderr)
    return status

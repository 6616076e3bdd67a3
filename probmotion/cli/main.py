"""Entry point of the command line: ``probmotion COMMAND [OPTIONS]``.

Each command is a dataclass whose fields are its options. Commands import libraries when they run,
so that help and errors appear immediately.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from importlib.metadata import version
from typing import Any

from probmotion.cli.compare import Compare
from probmotion.cli.denoise import Denoise
from probmotion.cli.files import Convert, Report, Show
from probmotion.cli.lift import Lift, Reconstruct
from probmotion.cli.pairs import Pairs
from probmotion.cli.reference import Reference
from probmotion.cli.which import Which

__all__ = ["List", "main"]

_OVERVIEW = """usage: probmotion COMMAND [OPTIONS]

Sample posteriors over 3D motion and measure the errors of samplers.

commands:
  compare      run samplers on the same posteriors and measure their errors
  report       write the report of a comparison again, from its folder
  which        recommend a sampler for a problem, from measurements
  list         list the named problems, samplers and skeletons
  show         summarise a file, or a network, sampler or problem by name
  convert      convert a motion to another format, frame rate or skeleton
  lift         lift a video's 2D keypoints to 3D motion, for Blender and the browser
  pairs        lift two people who interact, from a video's 2D keypoints and one 3D pose-pair
  reconstruct  reconstruct an animal or person in 3D and motion, from one image and its mask
  denoise      denoise recorded 3D joints and fill gaps
  train        train a prior, or a network for evaluating priors
  reference    generate certified reference draws of a problem

probmotion COMMAND --help lists the options of a command.
probmotion --version prints the version."""


@dataclass(frozen=True)
class List:
    """List the named problems, samplers and skeletons."""

    def run(self) -> None:
        from probmotion.cli.settings_options import presets_of
        from probmotion.motion.presets import PRESETS
        from probmotion.motion.skeleton import Skeleton
        from probmotion.posteriors.sampling import importable_samplers
        from probmotion.problems.catalogue import problem_descriptions

        _print_list("problems", problem_descriptions())
        kinds = importable_samplers()
        _print_list("samplers", {name: _first_line(kind) for name, kind in kinds.items()})
        presets = {
            f"{name}.{preset}": _first_line(getattr(kind, preset))
            for name, kind in kinds.items()
            for preset in presets_of(kind)
        }
        _print_list("sampler presets", presets)
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
    from probmotion.cli.settings_options import without_markup

    return without_markup(kind.__doc__).strip().partition("\n")[0]


_COMMANDS: dict[str, type[Any]] = {
    "compare": Compare, "report": Report, "which": Which, "list": List, "show": Show,
    "convert": Convert, "denoise": Denoise, "lift": Lift, "pairs": Pairs,
    "reconstruct": Reconstruct, "reference": Reference,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0, 2 for invalid input, 130 for Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(_OVERVIEW)
        return 0 if words else 2
    if words[0] == "--version":
        print(f"probmotion {version('probmotion')}")
        return 0
    commands = [*_COMMANDS, "train"]
    if words[0] not in commands:
        return _fail(f"command must be one of {', '.join(commands)}, got {words[0]!r}", 2)
    with warnings.catch_warnings():
        warnings.showwarning = _note
        try:
            try:
                _parse(words[0], words[1:]).run()
            finally:
                # Flush here, so that a closed pipe is caught below.
                sys.stdout.flush()
        except KeyboardInterrupt as error:
            return _fail(str(error) or "interrupted; nothing more was written", 130)
        except BrokenPipeError:
            # The reader has closed the pipe, as in `probmotion list | head`.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except OSError as error:
            named = error.filename and error.strerror
            return _fail(f"{error.filename}: {error.strerror}" if named else str(error), 2)
        except (ValueError, ModuleNotFoundError) as error:
            return _fail(str(error), 2)
        except MemoryError as error:
            return _fail(f"not enough memory: {error}", 2)
    return 0


def _parse(name: str, words: Sequence[str]) -> Any:
    """Return the command with its options; an invalid option exits with status 2."""
    import tyro

    prog = f"probmotion {name}"
    if name == "train":
        from probmotion.cli.train import TRAINABLE

        if words and words[0] in ("-h", "--help"):
            print(f"usage: {prog} KIND [OPTIONS]\n")
            _print_list("kinds", {kind: _first_line(what) for kind, what in TRAINABLE.items()})
            print(f"\n{prog} KIND --help lists the options of a kind.")
            raise SystemExit(0)
        known = ", ".join(TRAINABLE)
        if not words or words[0] not in TRAINABLE:
            got = repr(words[0]) if words else "none"
            raise ValueError(f"kind must be one of {known}, got {got}")
        return tyro.cli(TRAINABLE[words[0]], prog=f"{prog} {words[0]}", args=words[1:])
    kind = _COMMANDS[name]
    if kind is not Compare:
        return tyro.cli(kind, prog=prog, args=words)
    if not {"-h", "--help"}.isdisjoint(words):
        # probmotion show lists the settings of samplers.
        tyro.cli(Compare, prog=prog, args=["--help"])
    from probmotion.cli.settings_options import (
        objects_as_words,
        plain_docstrings,
        settings_of_samplers,
    )

    settings = settings_of_samplers(quick="--quick" in words)
    entry = ("settings", settings, field(default_factory=settings))
    with_settings = make_dataclass("Compare", [entry], bases=(Compare,), frozen=True)
    with_settings.__doc__ = Compare.__doc__
    with plain_docstrings(entry.type for entry in fields(settings)):
        return tyro.cli(with_settings, prog=prog, args=words, registry=objects_as_words())


def _note(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"probmotion: note: {message}", file=sys.stderr)


def _fail(message: str, status: int) -> int:
    print(f"probmotion: {message}", file=sys.stderr)
    return status

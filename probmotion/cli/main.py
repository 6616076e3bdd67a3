"""The command line: ``probmotion compare | which | list | show | convert | train | reference``.

Each command is a dataclass whose fields are its options. Libraries are imported by the command
that needs them, so that help and mistakes answer at once.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import Any

from probmotion.cli.compare import Compare
from probmotion.cli.files import Convert, Show
from probmotion.cli.reference import Reference
from probmotion.cli.which import Which

__all__ = ["List", "main"]

_OVERVIEW = """usage: probmotion COMMAND [OPTIONS]

One posterior over 3D motion, many samplers, and how wrong each of them is.

commands:
  compare    draw with several samplers from the same posteriors; print how far each is off
  which      say which sampler to take for a problem, by what was measured
  list       the problems, the samplers and the skeletons that are known by name
  show       say what is in a file of motion, keypoints, draws or a network; draw it
  convert    write a motion to another format, frame rate or skeleton
  train      learn a prior, or what priors are measured with
  reference  make reference draws of a problem, with a certificate of how right they are

probmotion COMMAND --help lists the options of a command."""


@dataclass(frozen=True)
class List:
    """List the problems, the samplers and the skeletons that are known by name."""

    def run(self) -> None:
        """Print three lists."""
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


_COMMANDS: dict[str, type[Any]] = {
    "compare": Compare, "which": Which, "list": List, "show": Show, "convert": Convert,
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
        return _complain(f"command must be one of {', '.join(commands)}, got {words[0]!r}", 2)
    with warnings.catch_warnings():
        warnings.showwarning = _note
        try:
            try:
                _parse(words[0], words[1:]).run()
            finally:
                # Here, where a reader that is gone is no error; not as Python ends.
                sys.stdout.flush()
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
        from probmotion.cli.train import TRAINABLE

        if words and words[0] in ("-h", "--help"):
            print(f"usage: {prog} KIND [OPTIONS]\n")
            _print_list("kinds", {kind: _first_line(what) for kind, what in TRAINABLE.items()})
            print(f"\n{prog} KIND --help lists the options of a kind.")
            raise SystemExit(0)
        known = ", ".join(TRAINABLE)
        if not words or words[0] not in TRAINABLE:
            got = repr(words[0]) if words else "missing"
            raise ValueError(f"what to train must be one of {known}, got {got}")
        return tyro.cli(TRAINABLE[words[0]], prog=f"{prog} {words[0]}", args=words[1:])
    kind = _COMMANDS[name]
    if kind is not Compare:
        return tyro.cli(kind, prog=prog, args=words)
    from probmotion.cli.settings_options import objects_as_words, settings_of_samplers

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

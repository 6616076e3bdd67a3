"""Command-line page of the documentation, generated from the help texts."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

_COMMANDS = (
    ("compare",), ("report",), ("which",), ("list",), ("show",), ("convert",), ("lift",),
    ("pairs",), ("reconstruct",), ("denoise",), ("reference",),
    ("train", "diffusion"), ("train", "evaluator"), ("train", "lifter"), ("train", "dvae"),
    ("train", "denoiser"), ("train", "motion-vae"), ("train", "images"),
)  # fmt: skip


@contextlib.contextmanager
def _called_as(command: tuple[str, ...]) -> Iterator[io.StringIO]:
    printed = io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["probmotion", *command, "--help"]),
        mock.patch.dict(os.environ, {"COLUMNS": "90", "NO_COLOR": "1", "TERM": "dumb"}),
        contextlib.redirect_stdout(printed),
    ):
        yield printed


def _help(command: tuple[str, ...]) -> str:
    from probmotion.cli.main import main

    with _called_as(command) as printed, contextlib.suppress(SystemExit):
        main()
    return printed.getvalue()


def write(docs: Path) -> None:
    """Write ``command-line.md``."""
    parts = ["# Command line", "", "`probmotion COMMAND --help` prints these texts.", ""]
    for command in _COMMANDS:
        text = "\n".join(line.rstrip() for line in _help(command).splitlines()).strip()
        if not text:
            raise RuntimeError(f"probmotion {' '.join(command)} --help printed nothing")
        parts += [f"## `probmotion {' '.join(command)}`", "", "```text", text, "```", ""]
    page = docs / "command-line.md"
    text = "\n".join(parts)
    if not page.exists() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")

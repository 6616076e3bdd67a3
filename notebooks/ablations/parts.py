"""Command line of ablations that consist of parts, each of which returns a table."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from probmotion.files import written_whole

__all__ = ["CLIPS", "arguments", "run_parts"]

CLIPS = Path(__file__).parents[3] / "shared" / "data"
"""Folder of the clips."""


def arguments(description: str, parts: Mapping[str, object]) -> argparse.ArgumentParser:
    """Return a parser of ``--out``, ``--parts`` and ``--quick``, to which options can be added.

    The first line of ``description`` is printed by ``--help``.
    """
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="Output folder.")
    names = list(parts)
    parser.add_argument("--parts", nargs="+", choices=names, default=names, help="Parts to run.")
    parser.add_argument("--quick", action="store_true", help="Synthetic data and few draws.")
    return parser


def printed(name: str, table: pd.DataFrame) -> str:
    """Return a table as it is printed."""
    return table.round(3).to_string(index=False)


def run_parts(
    study: Any,
    parts: Mapping[str, Callable[[Any], pd.DataFrame]],
    names: list[str],
    shown: Callable[[str, pd.DataFrame], str] = printed,
) -> None:
    """Write the tables of parts to ``study.out``, and print them as ``shown`` returns them."""
    study.out.mkdir(parents=True, exist_ok=True)
    for name in names:
        start = time.perf_counter()
        table = parts[name](study)
        with written_whole(study.out / f"{name}.csv") as path:
            table.to_csv(path, index=False)
        seconds = time.perf_counter() - start
        print(f"\n{name} ({seconds:.0f} s)\n{shown(name, table)}\n", flush=True)

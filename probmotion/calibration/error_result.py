"""Result of an error decomposition: parts of a sampler's error with confidence intervals."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.calibration.error_measures import MEASURES
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.files import check_format, read_json, write_json, written_whole
from probmotion.metrics.intervals import t_interval
from probmotion.validation import check_types

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ErrorDecomposition", "StoredValues"]

_FLOOR, _WHOLE = "floor", "whole"  # rows of the table besides the parts


class ErrorDecomposition:
    """Parts of a sampler's error on one problem, by measure and seed.

    Parameters
    ----------
    setting : str
        Title with the problem and the main settings.
    values : mapping of str to sequence of mapping
        Measures by sampler in the order of the chain (exact draws first), then by seed. Samplers
        are named after their part of the error.
    notes : sequence of str
        Notes on omitted parts.
    """

    def __init__(
        self,
        setting: str,
        values: Mapping[str, Sequence[Mapping[str, float]]],
        notes: Sequence[str] = (),
    ) -> None:
        self.setting = setting
        self.notes = list(notes)
        self.chain, *self.parts = values
        first = values[self.chain][0]
        self.values = {
            measure: {
                link: np.array([row[measure] for row in by_seed])
                for link, by_seed in values.items()
            }
            for measure in MEASURES
            if measure in first
        }

    def differences(self, measure: str) -> dict[str, np.ndarray]:
        """Return the values of each part, (seeds,); the parts add up to the total error."""
        if measure not in self.values:
            raise ValueError(f"measure must be one of {', '.join(self.values)}, got {measure!r}")
        links = list(self.values[measure].items())
        return {part: after - before for (_, before), (part, after) in itertools.pairwise(links)}

    def table(self) -> pd.DataFrame:
        """Return the tidy table: setting, measure, part, mean, low, high.

        The parts ``floor`` and ``whole`` are the measure of exact draws and the sum of all parts.
        ``low`` to ``high`` is a pointwise 95 % interval of the mean over seeds.
        """
        import pandas as pd

        rows = []
        for measure, by_link in self.values.items():
            parts = self.differences(measure)
            whole = np.sum(list(parts.values()), axis=0)
            for part, values in {_FLOOR: by_link[self.chain], **parts, _WHOLE: whole}.items():
                mean = float(values.mean())
                rows.append((self.setting, measure, part, mean, *t_interval(values)))
        return pd.DataFrame(rows, columns=["setting", "measure", "part", "mean", "low", "high"])

    @property
    def findings(self) -> list[str]:
        """Summaries of the measures: total error, and significant parts in decreasing order."""
        sentences = []
        table = self.table().set_index(["measure", "part"])
        for measure in self.values:
            rows = {part: table.loc[(measure, part)] for part in [*self.parts, _WHOLE]}
            clear = {part: row for part, row in rows.items() if row["low"] > 0 or row["high"] < 0}
            whole = clear.pop(_WHOLE, None)
            rows.pop(_WHOLE)
            total = "not significant" if whole is None else _with_interval(whole)
            words = [f"{measure}: total {total}"]
            if clear:
                ordered = sorted(clear, key=lambda part: -abs(clear[part]["mean"]))
                words.append(", ".join(f"{part} {_with_interval(clear[part])}" for part in ordered))
            if unclear := [part for part in rows if part not in clear]:
                words.append(f"not significant: {', '.join(unclear)}")
            sentences.append("; ".join(words))
        return sentences

    def plot(self, path: str | Path) -> Path:
        """Plot the parts to a .png, .pdf or .svg file, one panel per measure; return its path."""
        from probmotion.plots.error_plots import draw_error_decomposition

        draw_error_decomposition(self.table(), path, words=MEASURES, notes=self.notes)
        return Path(path)

    def write(self, path: str | Path) -> None:
        """Write the table as CSV."""
        with written_whole(Path(path)) as unfinished:
            self.table().to_csv(unfinished, index=False)


@dataclass(frozen=True)
class _StoredFile:
    """Content of ``decompose_error.json``."""

    question: str
    values: dict[str, dict[str, float]]


class StoredValues:
    """Stored measures of each sampler and seed, saved as JSON in ``folder`` unless it is None.

    ``question`` identifies the decomposition. Raises ``ValueError`` if the folder has another one.
    """

    def __init__(self, folder: Path | None, question: Any) -> None:
        self.path = None if folder is None else folder / "decompose_error.json"
        self.question = fingerprint(question)
        self._values: dict[str, dict[str, float]] = {}
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            stored = self._read()
            if stored.question != self.question:
                raise ValueError(
                    f"out must be a new folder, got {str(folder)!r} with another decomposition"
                )
            self._values = stored.values

    def _read(self) -> _StoredFile:
        assert self.path is not None
        try:
            content = dict(read_json(self.path))
            check_format(content)
            stored = _StoredFile(**content)
            check_types(stored)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{self.path} is damaged: {str(error)[:200]}; delete it to restart"
            ) from error
        return stored

    def get(self, name: str, seed: int) -> dict[str, float] | None:
        """Return the measures of a sampler and seed, or None if they are not stored."""
        return self._values.get(f"{name} {seed}")

    def put(self, name: str, seed: int, values: dict[str, float]) -> None:
        """Store the measures of a sampler and seed."""
        self._values[f"{name} {seed}"] = values
        if self.path is None:
            return
        content = {"format": 1, "question": self.question, "values": self._values}
        write_json(self.path, content)


def _with_interval(row: Any) -> str:
    return f"{row['mean']:+.3g} ({row['low']:+.3g} to {row['high']:+.3g})"

"""Quality against cost as a drawing in the page: crisp, with words that can be read out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.qualities import QUALITIES, first_quality
from probmotion.plots.colours import style_of
from probmotion.plots.label_placement import Box, place_labels

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["marker", "quality_against_cost"]

_WIDTH, _HEIGHT = 480, 340
_LEFT, _TOP, _RIGHT, _BOTTOM = 48, 30, 12, 42
_LETTER = 6.6
"""Width of a letter, pixels, about."""

_MARKERS = {
    "o": "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0z",
    "s": "M-4.5-4.5h9v9h-9z",
    "D": "M0-6L6 0L0 6L-6 0z",
    "^": "M0-6L5.5 4.5h-11z",
    "v": "M0 6L5.5-4.5h-11z",
    "P": "M-2-6h4v4h4v4h-4v4h-4v-4h-4v-4h4z",
    "X": "M-5.5-3L-3-5.5L0-2.5L3-5.5L5.5-3L2.5 0L5.5 3L3 5.5L0 2.5L-3 5.5L-5.5 3L-2.5 0z",
    "p": "M0-6L5.7-1.9L3.5 4.9H-3.5L-5.7-1.9z",
    "<": "M-6 0L4.5-5.5v11z",
    ">": "M6 0L-4.5-5.5v11z",
}
"""The shapes of :func:`~probmotion.plots.colours.style_of` as paths, about the origin."""


def marker(place: int) -> str:
    """Return the path of the sampler at a place in the order, in its colour."""
    _, shape = style_of(place)
    return f'<path class="sampler-{place % 9}" d="{_MARKERS[shape]}"/>'


def quality_against_cost(
    table: pd.DataFrame, problem: str, samplers: Mapping[str, str], place: int
) -> str:
    """Return the drawing of one problem as HTML; empty where no sampler has a point.

    A point is the mean over seeds, its bars run from the least to the greatest seed. Both axes are
    logarithmic.

    Parameters
    ----------
    table : DataFrame
        Columns problem, sampler, seed, metric, value.
    problem : str
        Its name.
    samplers : mapping of str
        All of the comparison's, in the order of their colours: why one has no draws, in a word;
        empty where it has.
    place : int
        The problem's number in the page, for its ids.
    """
    rows = table[table["problem"] == problem]
    quality = first_quality(rows)
    points = _points(rows, quality, list(samplers)) if quality else {}
    if quality is None or not points:
        return ""
    drawing = _drawn(
        points, list(samplers), problem, QUALITIES[quality], quality == "swd_ratio", place
    )
    return f'<figure class="plot">{drawing}{_absent(points, samplers)}</figure>'


Point = tuple[np.ndarray, np.ndarray]
"""Seconds and quality, (seeds,) each."""


def _points(rows: pd.DataFrame, quality: str, samplers: Sequence[str]) -> dict[str, Point]:
    """Return seconds and quality by sampler, over the seeds that have both above zero."""
    points = {}
    for sampler in samplers:
        own = rows[rows["sampler"] == sampler]
        both = [
            own[own["metric"] == name].set_index("seed")["value"] for name in ("seconds", quality)
        ]
        seeds = both[0].index.intersection(both[1].index)
        pair = np.array([values.loc[seeds].to_numpy(float) for values in both])
        pair = pair[:, (np.isfinite(pair) & (pair > 0)).all(axis=0)]
        if pair.shape[1]:
            points[sampler] = (pair[0], pair[1])
    return points


def _drawn(
    points: Mapping[str, Point],
    samplers: Sequence[str],
    problem: str,
    words: str,
    with_right: bool,
    place: int,
) -> str:
    costs, qualities = (np.concatenate(values) for values in zip(*points.values(), strict=True))
    across = _Axis.around(costs, _LEFT, _WIDTH - _RIGHT)
    # Never so close that small differences look large.
    up = _Axis.around(np.append(qualities, [qualities.min() * 2]), _HEIGHT - _BOTTOM, _TOP)
    parts = [
        f'<path class="grid" d="M{x:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>'
        f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 16}" text-anchor="middle">{tick:g}</text>'
        for tick, x in across.ticks()
    ]
    parts += [
        f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>'
        f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>'
        for tick, y in up.ticks()
    ]
    parts.append(f'<text x="4" y="18">{escape(words)}</text>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">seconds</text>')
    if with_right and up.low <= 0 <= up.high:
        parts.append(f'<path class="right" d="M{_LEFT} {up(1.0):.1f}H{_WIDTH - _RIGHT}"/>')
    marks: dict[str, Box] = {}
    for sampler, (cost, quality) in points.items():
        number = samplers.index(sampler)
        x, y = across(float(cost.mean())), up(float(quality.mean()))
        left, right = across(float(cost.min())), across(float(cost.max()))
        top, bottom = up(float(quality.max())), up(float(quality.min()))
        marks[sampler] = (left - 6, top - 6, right + 6, bottom + 6)
        parts.append(
            f'<path class="bar sampler-{number % 9}" '
            f'd="M{left:.1f} {y:.1f}H{right:.1f}M{x:.1f} {top:.1f}V{bottom:.1f}"/>'
            f'<g transform="translate({x:.1f} {y:.1f})">{marker(number)}</g>'
        )
    parts += _labels(marks)
    said = "; ".join(
        f"{sampler}: {quality.mean():.3g} at {cost.mean():.3g} seconds"
        for sampler, (cost, quality) in points.items()
    )
    return f"""\
<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" \
aria-labelledby="plot-{place} plot-{place}-said">
<title id="plot-{place}">Quality against cost on {escape(problem)}</title>
<desc id="plot-{place}-said">{escape(words)}, against seconds, both on logarithmic axes; means \
over seeds. {escape(said)}.</desc>
{chr(10).join(parts)}
</svg>"""


def _absent(points: Mapping[str, Point], samplers: Mapping[str, str]) -> str:
    """Say who has no point and why: nobody is left out without a word."""
    listed = ", ".join(
        f"{sampler} ({word or 'not measured'})"
        for sampler, word in samplers.items()
        if sampler not in points
    )
    return f"<figcaption>no point: {escape(listed)}</figcaption>" if listed else ""


def _labels(marks: Mapping[str, Box]) -> list[str]:
    sizes = {name: (_LETTER * len(name), 14.0) for name in marks}
    room = (_LEFT, _TOP, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM)
    parts = []
    for name, (box, far) in place_labels(marks, sizes, room).items():
        x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        if far:
            mark = marks[name]
            end = (mark[0] + mark[2]) / 2, (mark[1] + mark[3]) / 2
            parts.append(f'<path class="grid" d="M{x:.1f} {y:.1f}L{end[0]:.1f} {end[1]:.1f}"/>')
        parts.append(
            f'<text class="halo" x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">'
            f"{escape(name)}</text>"
        )
    return parts


class _Axis:
    """A logarithmic axis: a value's place in pixels."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        self.low, self.high, self.start, self.end = low, high, start, end

    @classmethod
    def around(cls, values: np.ndarray, start: float, end: float) -> _Axis:
        low, high = math.log10(values.min()), math.log10(values.max())
        margin = max(0.08 * (high - low), 0.1)
        return cls(low - margin, high + margin, start, end)

    def __call__(self, value: float) -> float:
        share = (math.log10(value) - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[tuple[float, float]]:
        """Plain numbers and their places."""
        decades = self.high - self.low
        steps = (
            (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 0.8 else (1, 1.5, 2, 3, 5, 7)
        )
        powers = range(math.floor(self.low), math.ceil(self.high) + 1)
        every = max(1, round(decades / 6))
        numbers = [step * 10.0**power for power in powers if power % every == 0 for step in steps]
        return [(n, self(n)) for n in numbers if self.low <= math.log10(n) <= self.high]

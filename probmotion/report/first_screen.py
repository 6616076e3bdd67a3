"""First screen of the report: sentences, verdicts, quality against cost and an animation."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

from probmotion.comparison.results.summary import problem_sentence, verdict_text
from probmotion.metrics.verdict import Quantity, Verdict
from probmotion.report.animations import compared_draws, featured_problem
from probmotion.report.tables import Outcome, sampler_name

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["first_screen"]

_MAX_ROWS = 10  # Maximum number of samplers of a table below the animation.
_MAX_COLUMNS = 3  # Maximum number of problems of a table beside the animation.
_MAX_SENTENCES = 4  # Maximum number of sentences without scrolling.
_SYMBOLS = {"right": "●", "undecided": "○", "wrong": "▲", "failed": "✕", "none": "–"}


def first_screen(
    comparison: GridResults,
    verdicts: Mapping[str, Mapping[str, Verdict]],
    outcomes: Mapping[str, Mapping[str, Outcome]],
    plot: str,
) -> str:
    """Return the first screen as HTML.

    ``verdicts`` and ``outcomes`` are indexed by problem and sampler; ``plot`` is the image of
    quality against cost on the featured problem, as HTML.
    """
    plan = comparison.plan
    items = "".join(
        f'<li><a href="#problem-{place}">{escape(name)}</a> '
        f"<span>{escape(problem_sentence(comparison, name))}</span></li>"
        for place, name in enumerate(plan.problems)
    )
    featured = featured_problem(comparison)
    is_short = len(plan.problems) <= _MAX_COLUMNS
    beside = is_short and len(plan.samplers) > _MAX_ROWS
    many = ' many" tabindex="0' if len(plan.problems) > _MAX_SENTENCES else ""
    animation = compared_draws(comparison, featured, verdicts[featured])
    return f"""\
<div class="answer{" beside" if beside else ""}">
<ul class="sentences{many}" aria-label="Verdicts in words">{items}</ul>
<section class="featured" aria-labelledby="featured-name">
<h2 id="featured-name">Draws on {escape(featured)}</h2>
{animation or '<p class="quiet">No draws are available.</p>'}
</section>
<section class="verdicts" aria-labelledby="verdicts-name">
<h2 id="verdicts-name">Verdicts</h2>
{_verdict_table(comparison, verdicts, outcomes, detailed=is_short and not beside)}
</section>
<section class="cost" aria-labelledby="cost-name">
<h2 id="cost-name">Quality against cost</h2>
{plot or '<p class="quiet">No sampler has both a quality and a cost.</p>'}
</section>
</div>"""


def _verdict_table(
    comparison: GridResults,
    verdicts: Mapping[str, Mapping[str, Verdict]],
    outcomes: Mapping[str, Mapping[str, Outcome]],
    detailed: bool,
) -> str:
    problems, samplers = comparison.plan.problems, comparison.plan.samplers
    header = "".join(
        f'<th scope="col"><a href="#problem-{place}">{escape(name)}</a></th>'
        for place, name in enumerate(problems)
    )
    rows, numbers = [], []
    for i, sampler in enumerate(samplers):
        cells = []
        for j, problem in enumerate(problems):
            verdict, key = verdicts[problem].get(sampler), f"verdict-{j}-{i}"
            text = verdict_text(comparison, problem, sampler)
            cell = _cell(verdict, text, outcomes[problem][sampler], key)
            if detailed and verdict is not None:
                cell += f'<span class="rest">{escape(_rest(verdict, text))}</span>'
            cells.append(f"<td>{cell}</td>")
            if verdict is not None and verdict.word != "failed":
                numbers.append(_numbers(verdict, f"{sampler} on {problem}", key))
        rows.append(f'<tr><th scope="row">{sampler_name(sampler)}</th>{"".join(cells)}</tr>')
    return f"""\
<div class="scroll" tabindex="0" role="region" aria-labelledby="verdicts-name">\
<table{' class="detailed"' if detailed else ""}>
<thead><tr><th scope="col">sampler</th>{header}</tr></thead>
<tbody>
{chr(10).join(rows)}
</tbody></table></div>
{chr(10).join(numbers)}"""


def _cell(verdict: Verdict | None, text: str, outcome: Outcome, key: str) -> str:
    """Return a symbol and a text, which open the numbers or link to the reason."""
    kind = "none" if verdict is None or outcome.unsupported else verdict.word
    kind = kind if kind in _SYMBOLS else "wrong"
    shown = f'<span class="symbol" aria-hidden="true">{_SYMBOLS[kind]}</span>{escape(text)}'
    if verdict is None or verdict.word == "failed":
        if not outcome.word:
            return f'<span class="word none" title="no reference draws">{shown}</span>'
        title = escape(outcome.sentences)
        return f'<a class="word {kind}" href="#{outcome.note}" title="{title}">{shown}</a>'
    title = "\n".join([verdict.sentence, *(_line(each) for each in verdict.quantities)])
    return (
        f'<button type="button" class="word {kind}" popovertarget="{key}" '
        f'title="{escape(title)}">{shown}</button>'
    )


def _rest(verdict: Verdict, text: str) -> str:
    """Return what the sentence of a verdict adds to its text."""
    rest = verdict.sentence.removeprefix(verdict.word)
    return rest.removeprefix(text.removeprefix(verdict.word))


def _numbers(verdict: Verdict, name: str, key: str) -> str:
    """Return the tested quantities of a verdict as a popover."""
    table = "".join(
        f'<tr><th scope="row">{escape(each.name)}</th><td>{each.estimate:.3g}</td>'
        f"<td>{_tolerance(each)}</td><td>{_shown(each)}</td></tr>"
        for each in verdict.quantities
    )
    if table:
        table = (
            '<table><thead><tr><th scope="col">quantity</th><th scope="col">estimate</th>'
            '<th scope="col">tolerance</th><th scope="col">shown</th></tr></thead>'
            f"<tbody>{table}</tbody></table>"
        )
    return f"""\
<div popover id="{key}" class="numbers"><h3>{escape(name)}</h3>
<p>{escape(verdict.sentence)}</p>
{table}
<p class="quiet">n = {verdict.n} draws, for chains the effective number</p></div>"""


def _line(quantity: Quantity) -> str:
    return f"{quantity.name} {quantity.estimate:.3g} ({_tolerance(quantity)}): {_shown(quantity)}"


def _tolerance(quantity: Quantity) -> str:
    if quantity.ideal == 1:
        return f"{1 / quantity.tolerance:.3g}–{quantity.tolerance:.3g}"
    return f"≤ {quantity.tolerance:.3g}"


def _shown(quantity: Quantity) -> str:
    """Return what a test at 5 % shows of a quantity."""
    if quantity.p_outside <= 0.05:
        return "inside"
    if quantity.outside and quantity.p_differs <= 0.05:
        return "outside"
    return "open"

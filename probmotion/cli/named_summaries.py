"""Summaries of samplers, presets and problems for ``probmotion show``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from textwrap import fill, indent
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from probmotion.cli.settings_options import (
    object_kinds,
    option_name,
    presets_of,
    sampler_called,
    text_of_setting,
    without_markup,
)
from probmotion.posteriors.sampling import load_sampler, sampler_names, suited
from probmotion.problems.catalogue import load_problem, problem_names
from probmotion.validation import did_you_mean

__all__ = ["summarise_named"]

_WIDTH = 100
_READABLE = {"int", "float", "str", "bool", "tuple", "None"}


def summarise_named(name: str) -> str | None:
    """Return a summary of the sampler, preset or problem ``name``; None for the name of a file.

    Raises
    ------
    ValueError
        If no sampler, preset or problem has this name.
    FileNotFoundError
        If the data of a problem are missing.
    """
    sampler, _, preset = (name, "", "") if name in sampler_names() else name.partition(".")
    if sampler in sampler_names():
        return "\n".join(_of_sampler(sampler, preset))
    if name.partition("(")[0] in problem_names():
        return _of_problem(name)
    if Path(name).suffix or len(Path(name).parts) > 1:
        return None
    hint = did_you_mean(name, [*sampler_names(), *problem_names()])
    raise ValueError(
        "file must be an existing file or the name of a network, sampler or problem, got "
        f"{name!r}{hint}"
    )


def _of_sampler(name: str, preset: str) -> Iterator[str]:
    from docstring_parser import parse

    called = f"{name}.{preset}" if preset else name
    sampler = sampler_called(called, None)
    kind = load_sampler(name)
    described = parse(without_markup(getattr(kind, preset).__doc__ if preset else kind.__doc__))
    yield f"{called}: {described.short_description or 'a sampler'}"
    if described.long_description:
        paragraphs = described.long_description.split("\n\n")
        yield from ("", *(fill(paragraph, _WIDTH) for paragraph in paragraphs))
    if not preset and (presets := presets_of(kind)):
        yield f"\npresets: {', '.join(f'{name}.{each}' for each in presets)}"
    settings = [entry for entry in fields(kind) if entry.init] if is_dataclass(kind) else []
    if not settings:
        return
    if preset:
        yield "\nsettings:"
    else:
        option = f"--settings.{_hyphened(option_name(name))}.NAME VALUE"
        yield f"\nsettings and their defaults, changed by probmotion compare … {option}:"
    hints = get_type_hints(kind)
    meanings = {
        setting: " ".join((meaning.description or "").split())
        for meaning in parse(without_markup(kind.__doc__)).params
        for setting in meaning.arg_name.split(", ")
    }
    for entry in settings:
        setting, value = _hyphened(entry.name), getattr(sampler, entry.name)
        text = value if isinstance(value, str) else text_of_setting(value)
        allowed = _type_text(hints[entry.name])
        if isinstance(value, bool):  # an option without a value
            allowed = f"{setting} or no-{setting}"
        yield f"  {setting} = {text}  ({allowed})"
        yield indent(fill(meanings.get(entry.name, ""), _WIDTH - 6), " " * 6)


def _hyphened(name: str) -> str:
    return name.replace("_", "-")


def _type_text(hint: Any) -> str:
    """Return a type as text; types that the command line cannot read are marked."""
    if get_origin(hint) is Literal:
        return " | ".join(map(str, get_args(hint)))
    if kinds := object_kinds(hint):
        return " | ".join(kind.__name__ for kind in kinds)
    union = isinstance(hint, UnionType) or get_origin(hint) is Union
    parts = get_args(hint) if union else (hint,)
    names = ["None" if part is NoneType else getattr(part, "__name__", str(part)) for part in parts]
    return " | ".join(names) + ("" if _READABLE.issuperset(names) else "; in Python only")


def _of_problem(name: str) -> str:
    problem = load_problem(name)
    posterior = problem.posterior
    likelihood = posterior.likelihood
    observations = "none" if likelihood is None else type(likelihood).__name__
    dim = getattr(posterior.prior, "dim", None)
    coordinates = "" if dim is None else f", {dim} coordinates"
    return "\n".join(
        (
            f"{problem.name}: {problem.description}",
            f"  {posterior.frames} frames at {posterior.fps:g} fps, "
            f"{posterior.skeleton.n_joints} joints{coordinates}",
            f"  prior {type(posterior.prior).__name__}, observations {observations}",
            f"  reference draws: {'yes' if problem.has_reference else 'no'}",
            f"  samplers: {', '.join(suited(posterior))}",
        )
    )

"""Command-line options for the settings of samplers, generated from their dataclasses.

Settings that are numbers or strings are separate options. Settings that are objects, such as a
guidance or a proposal, are written as in Python: ``DPS`` or ``DPS(strength=0.5)``.
"""

from __future__ import annotations

import ast
import re
import sys
import types
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import field, fields, is_dataclass, make_dataclass
from functools import partial
from inspect import Parameter, signature
from keyword import iskeyword
from typing import TYPE_CHECKING, Any, Union, get_args

from probmotion.posteriors.sampling import (
    default_sampler,
    importable_samplers,
    load_sampler,
    sampler_names,
)

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

__all__ = [
    "object_kinds",
    "objects_as_words",
    "option_name",
    "plain_docstrings",
    "presets_of",
    "sampler_called",
    "settings_of_samplers",
    "text_of_setting",
    "without_markup",
]


def option_name(sampler: str) -> str:
    """Return the name of a sampler, converted to a Python identifier."""
    name = re.sub(r"\W", "_", sampler)
    return name if name.isidentifier() and not iskeyword(name) else f"sampler_{name}"


def settings_of_samplers(quick: bool = False) -> type[Any]:
    """Return a dataclass with a field per registered sampler; ``quick`` sets quick-run defaults."""
    reduced = {}
    if quick:
        from probmotion.comparison.quick import quick_samplers

        reduced = quick_samplers()
    entries: dict[str, tuple[type, Any]] = {}
    for name, kind in importable_samplers().items():
        default = partial(_same, reduced[name]) if quick else kind
        # If two names yield the same identifier, only the first sampler has options.
        entries.setdefault(option_name(name), (kind, field(default_factory=default)))
    settings = make_dataclass(
        "Settings", [(name, *entry) for name, entry in entries.items()], frozen=True
    )
    settings.__doc__ = "Settings of the samplers."
    return settings


def _same(value: Any) -> Any:
    return value


_MARKUP = re.compile(r"\s*\(:\w+:`[^`]*`\)|:\w+:`~?(?:[\w.]+\.)?(\w+)`|`+([^`]+)`+")
"""References in parentheses, roles and literals of reStructuredText."""


def without_markup(text: str | None) -> str:
    """Return a docstring as plain text."""
    return _MARKUP.sub(lambda match: match[1] or match[2] or "", text or "")


@contextmanager
def plain_docstrings(kinds: Iterable[Any]) -> Iterator[None]:
    """Remove the markup from the docstrings of classes while tyro reads them."""
    docstrings = {kind: kind.__doc__ for kind in kinds}
    for kind, text in docstrings.items():
        kind.__doc__ = without_markup(text)
    try:
        yield
    finally:
        for kind, text in docstrings.items():
            kind.__doc__ = text


def presets_of(kind: type) -> list[str]:
    """Return the names of a sampler's presets: public class methods without required arguments."""
    return [
        name
        for name, member in vars(kind).items()
        if isinstance(member, classmethod)
        and not name.startswith("_")
        and all(
            parameter.default is not Parameter.empty
            for parameter in signature(getattr(kind, name)).parameters.values()
        )
    ]


def sampler_called(name: str, settings: Any) -> Any:
    """Return the sampler ``name`` with its settings, or the preset ``sampler.preset``.

    ``settings`` is an instance of the class from :func:`settings_of_samplers`.

    Raises
    ------
    ValueError
        If the sampler or preset is unknown, or the sampler has settings without defaults.
    """
    # Third-party samplers may have a dot in their names.
    base, _, preset = (name, "", "") if name in sampler_names() else name.partition(".")
    kind = load_sampler(base)
    if not preset:
        sampler = getattr(settings, option_name(base), None)
        return sampler if type(sampler) is kind else default_sampler(base)
    known = presets_of(kind)
    if preset not in known:
        names = ", ".join(f"{base}.{item}" for item in known) or f"{base}, which has no presets"
        raise ValueError(f"sampler must be {names}, got {name!r}")
    return getattr(kind, preset)()


def objects_as_words() -> ConstructorRegistry:
    """Return a tyro registry with a rule for settings that accept one of several dataclasses."""
    from tyro.constructors import ConstructorRegistry

    registry = ConstructorRegistry()
    registry.primitive_rule(_rule)
    return registry


def _rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    from tyro.constructors import PrimitiveConstructorSpec

    kinds = object_kinds(info.type)
    if not kinds:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="|".join(kind.__name__ for kind in kinds),
        instance_from_str=lambda words: object_from_text(words[0], kinds),
        is_instance=lambda value: isinstance(value, tuple(kinds)),
        str_from_instance=lambda value: [text_of_object(value)],
    )


def object_kinds(annotation: Any) -> list[type]:
    """Return the dataclasses that an annotation allows: those of a union or a protocol."""
    if isinstance(annotation, types.UnionType) or getattr(annotation, "__origin__", None) is Union:
        kinds = list(get_args(annotation))
        return kinds if all(is_dataclass(kind) for kind in kinds) else []
    if getattr(annotation, "_is_protocol", False):
        public = vars(sys.modules[annotation.__module__])
        named = [public[name] for name in public.get("__all__", [])]
        return [kind for kind in named if isinstance(kind, type) and is_dataclass(kind)]
    return []


def object_from_text(text: str, kinds: Iterable[type]) -> Any:
    """Return the object written as ``"DPS"`` or ``"DPS(strength=0.5)"``.

    Only names of ``kinds`` and literals are accepted; nothing is evaluated. Raises ``ValueError``
    for other text.
    """
    known = {kind.__name__: kind for kind in kinds}
    built = None
    # Python before 3.11.4 refuses null characters with ValueError.
    with suppress(SyntaxError, MemoryError, RecursionError):
        if "\0" not in text:
            built = _build(ast.parse(text.strip(), mode="eval").body, known)
    if type(built) not in known.values():
        raise ValueError(
            f"setting must be one of {', '.join(known)}, with options such as Name(option=1), got "
            f"{text[:80]!r}"
        )
    return built


def _build(tree: ast.expr, known: dict[str, type]) -> Any:
    name = tree.func if isinstance(tree, ast.Call) else tree
    if not isinstance(name, ast.Name):
        try:
            return ast.literal_eval(tree)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"options must be numbers, strings or settings, got {ast.unparse(tree)[:80]!r}"
            ) from error
    if name.id not in known:
        raise ValueError(f"setting must be one of {', '.join(known)}, got {name.id[:80]!r}")
    kind: Any = known[name.id]
    if not isinstance(tree, ast.Call):
        return kind()
    settings = [entry.name for entry in fields(kind) if entry.init]
    for keyword in tree.keywords:
        if keyword.arg not in settings:
            raise ValueError(
                f"options of {name.id} must be among {', '.join(settings)}, got {keyword.arg!r:.80}"
            )
    given = [_build(value, known) for value in tree.args]
    options = {str(keyword.arg): _build(keyword.value, known) for keyword in tree.keywords}
    try:
        return kind(*given, **options)
    except TypeError as error:
        raise ValueError(f"options of {name.id} must be valid values, got {error}") from error


def text_of_object(value: Any) -> str:
    """Return ``value`` as text for :func:`object_from_text`, without default settings."""
    changed = [
        f"{entry.name}={text_of_setting(getattr(value, entry.name))}"
        for entry in fields(value)
        if entry.init and getattr(value, entry.name) != entry.default
    ]
    name = type(value).__name__
    return f"{name}({', '.join(changed)})" if changed else name


def text_of_setting(value: Any) -> str:
    """Return ``value`` as text for the command line."""
    return text_of_object(value) if is_dataclass(value) else repr(value)

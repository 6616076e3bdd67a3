"""What a sampler is, which samplers there are, and what to say when one does not fit."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import UnionType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, get_args, runtime_checkable

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior

if TYPE_CHECKING:
    from probmotion.posteriors.draws import MotionDraws

__all__ = [
    "Interrupted",
    "Sampler",
    "UnsupportedPosterior",
    "importable_samplers",
    "load_sampler",
    "missing",
    "progress_bar",
    "require",
    "sampler_names",
    "suited",
]


@runtime_checkable
class Sampler(Protocol):
    """A frozen dataclass of settings that draws from a posterior.

    ``name`` is what tables call it; ``requires`` lists the protocols of
    :mod:`probmotion.posteriors.protocols` that the posterior's prior must implement. Where one of
    two is enough it holds their union, ``A | B``.
    """

    name: ClassVar[str]
    # Of type | UnionType; Any, because a sampler that needs no union may say tuple[type, ...].
    requires: ClassVar[tuple[Any, ...]]

    def sample(
        self,
        posterior: MotionPosterior,
        *,
        draws: int = 1000,
        chains: int = 1,
        seed: int = 0,
        initial: MotionDraws | np.ndarray | None = None,
        progress: bool = True,
    ) -> MotionDraws:
        """Return ``chains`` × ``draws`` draws.

        Raises
        ------
        UnsupportedPosterior
            If the posterior is not one that this sampler can draw from.
        """


class UnsupportedPosterior(ValueError):  # noqa: N818 (the name is the design's)
    """A sampler cannot draw from a posterior.

    Parameters
    ----------
    sampler : str
        The sampler's name.
    reason : str
        Why, as the rest of a sentence that begins with the sampler's name.
    word : str
        The same in one word, for tables.
    others : iterable of str, optional
        Samplers that would do.
    """

    def __init__(self, sampler: str, reason: str, word: str, others: Iterable[str] = ()) -> None:
        would_do = ", ".join(others)
        hint = f"; {would_do} would do" if would_do else ""
        super().__init__(f"{sampler} {reason}{hint}")
        self.word = word


class Interrupted(KeyboardInterrupt):
    """Ctrl-C stopped a sampler; what it had finished is not lost.

    It is a ``KeyboardInterrupt``, so that a program that does not know it stops as usual.

    Parameters
    ----------
    draws : MotionDraws
        The finished draws, the same number in every chain. A chain sampler goes on from them:
        ``sampler.sample(posterior, …, initial=interrupted.draws)``.
    """

    def __init__(self, draws: MotionDraws) -> None:
        finished = draws.dataset.sizes["draw"]
        super().__init__(f"interrupted after {finished} draws per chain, kept in .draws")
        self.draws = draws


def missing(sampler: type[Any] | Sampler, posterior: MotionPosterior) -> list[type | UnionType]:
    """Return the protocols that ``sampler`` requires and the posterior's prior lacks.

    A union is lacking where none of its protocols is there.
    """
    return [needed for needed in sampler.requires if not isinstance(posterior.prior, needed)]


def require(sampler: Sampler, posterior: MotionPosterior) -> None:
    """Raise :class:`UnsupportedPosterior` if the prior lacks a protocol the sampler requires.

    A prior that another can be made from says how in a mapping ``stand_ins``, by protocol's name.
    """
    lacking = missing(sampler, posterior)
    if lacking:
        names = [[one.__name__ for one in get_args(needed) or (needed,)] for needed in lacking]
        stand_ins = getattr(posterior.prior, "stand_ins", {})
        hints = [f"; {stand_ins[one]}" for some in names for one in some if one in stand_ins]
        raise UnsupportedPosterior(
            sampler.name,
            f"needs a prior with {' and '.join(map(' or '.join, names))}, which "
            f"{type(posterior.prior).__name__} is not{''.join(hints)}",
            word=names[0][0],
            others=suited(posterior),
        )


def suited(posterior: MotionPosterior) -> list[str]:
    """Return the names of the registered samplers that can draw from a posterior.

    The prior has what they require, a gradient where they need one (``needs_gradient``), no more
    dimensions than they take by default (``largest_dim``), and what a static method ``draws_from``
    asks of the posterior. One that cannot be imported, as of
    a package that is half removed, is none.
    """
    return [
        name
        for name, kind in _imported({}).items()
        if not missing(kind, posterior)
        and (posterior.differentiable or not getattr(kind, "needs_gradient", False))
        and posterior.dim <= getattr(kind, "largest_dim", posterior.dim)
        and (not hasattr(kind, "draws_from") or kind.draws_from(posterior))
    ]


def importable_samplers() -> dict[str, type[Any]]:
    """Return the classes of all registered samplers that have defaults, by name.

    One that cannot be imported, as of a package that is half removed, or not be made without
    settings, is left out, and a warning says so: whoever asks for all is not stopped by one.
    """
    refused: dict[str, ValueError] = {}
    found = {}
    for name, kind in _imported(refused).items():
        try:
            default_sampler(name)
            found[name] = kind
        except ValueError as error:
            refused[name] = error
    for reason in refused.values():
        warnings.warn(f"{reason}; it is left out", stacklevel=2)
    return found


def _imported(refused: dict[str, ValueError]) -> dict[str, type[Any]]:
    found = {}
    for name in sampler_names():
        try:
            found[name] = load_sampler(name)
        except ValueError as error:
            refused[name] = error
    return found


@cache
def _registered() -> dict[str, EntryPoint]:
    kept: dict[str, EntryPoint] = {}
    # The library's own first: nobody else's takes the place of one.
    points = entry_points(group="probmotion.samplers")
    for point in sorted(points, key=lambda point: _package_of(point) != "the package probmotion"):
        first = kept.setdefault(point.name, point)
        if first.value != point.value:
            warnings.warn(
                f"sampler {point.name!r} of {_package_of(point)} is left out: "
                f"{_package_of(first)} has one of that name",
                stacklevel=3,
            )
    return kept


def _package_of(point: EntryPoint) -> str:
    return f"the package {point.dist.name}" if point.dist else "a package without a name"


def sampler_names() -> list[str]:
    """Return the names of all registered samplers, ours and other packages'.

    A package registers a sampler by an entry point of the group ``probmotion.samplers``.
    """
    return list(_registered())


def load_sampler(name: str) -> type[Any]:
    """Return the class of a registered sampler.

    Raises
    ------
    ValueError
        If no sampler has that name; the message lists the known ones. Or it cannot be imported;
        the message says from where, whose it is and why.
    """
    known = _registered()
    if name not in known:
        raise ValueError(f"sampler must be one of {', '.join(sorted(known))}, got {name!r}")
    point = known[name]
    try:
        return point.load()
    # A package of somebody else's may fail in any way as it is imported.
    except Exception as error:
        raise ValueError(
            f"sampler is {name!r}, which {_package_of(point)} registers as {point.value!r}, "
            f"expected one that can be imported ({_in_a_line(error)})"
        ) from error


def default_sampler(name: str) -> Any:
    """Return a registered sampler with its default settings.

    Raises
    ------
    ValueError
        As :func:`load_sampler`, or if it cannot be made without settings.
    """
    kind = load_sampler(name)
    try:
        return kind()
    except Exception as error:
        raise ValueError(
            f"sampler is {name!r}, which cannot be made without settings ({_in_a_line(error)}), "
            "expected an object with its settings"
        ) from error


def _in_a_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


class _Silent:
    """A progress bar that shows nothing."""

    def update(self, n: int = 1) -> None:
        """Count ``n`` more."""


@contextmanager
def progress_bar(total: int, label: str, show: bool) -> Iterator[Any]:
    """Show a bar that counts to ``total`` on standard error; yields an object with ``update(n)``.

    A bar never touches what is computed.
    """
    if not show:
        yield _Silent()
        return
    from tqdm import tqdm

    with tqdm(total=total, desc=label, leave=False, dynamic_ncols=True) as bar:
        yield bar


def batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Yield ``items`` in order, at most ``size`` at a time."""
    for start in range(0, len(items), size):
        yield items[start : start + size]

"""Sampler protocol, sampler registry and compatibility checks."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import SimpleNamespace, UnionType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, get_args, runtime_checkable

import numpy as np

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.validation import did_you_mean

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
    """Sampler of a posterior: a frozen dataclass of settings.

    ``requires`` lists the protocols of :mod:`probmotion.posteriors.protocols` that the prior must
    implement; a union ``A | B`` requires A or B.
    """

    @property
    def name(self) -> str:
        """Name in tables."""

    # Any permits samplers to annotate tuple[type, ...] if they use no unions.
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
        """Return ``draws`` draws from each of ``chains`` chains."""


class UnsupportedPosterior(ValueError):  # noqa: N818 (public name)
    """Error for a posterior that a sampler does not support.

    ``reason`` completes a sentence that begins with the sampler's name, ``word`` is a one-word
    reason for tables, and ``others`` are the names of suitable samplers.
    """

    def __init__(self, sampler: str, reason: str, word: str, others: Iterable[str] = ()) -> None:
        names = ", ".join(others)
        super().__init__(f"{sampler} {reason}" + (f"; try {names}" if names else ""))
        self.word = word


class Interrupted(KeyboardInterrupt):
    """Interruption of a sampler by Ctrl-C; ``draws`` are those finished by all chains.

    Continue a chain sampler with ``sampler.sample(posterior, …, initial=interrupted.draws)``.
    """

    def __init__(self, draws: MotionDraws) -> None:
        n = draws.dataset.sizes["draw"]
        super().__init__(f"interrupted after {n} draws per chain, stored in .draws")
        self.draws = draws


def missing(sampler: type[Any] | Sampler, posterior: MotionPosterior) -> list[type | UnionType]:
    """Return the protocols that ``sampler`` requires but the prior does not implement."""
    return [needed for needed in sampler.requires if not isinstance(posterior.prior, needed)]


def require(sampler: Sampler, posterior: MotionPosterior) -> None:
    """Raise :class:`UnsupportedPosterior` if the prior lacks a required protocol.

    A prior's optional mapping ``stand_ins``, from protocol names to hints, extends the message.
    """
    protocols = missing(sampler, posterior)
    if protocols:
        names = [[kind.__name__ for kind in get_args(needed) or (needed,)] for needed in protocols]
        stand_ins = getattr(posterior.prior, "stand_ins", {})
        hints = [f"; {stand_ins[kind]}" for union in names for kind in union if kind in stand_ins]
        raise UnsupportedPosterior(
            sampler.name,
            f"needs a prior with {' and '.join(map(' or '.join, names))}, got "
            f"{type(posterior.prior).__name__}{''.join(hints)}",
            word=names[0][0],
            others=suited(posterior),
        )


def suited(posterior: MotionPosterior) -> list[str]:
    """Return the names of the importable registered samplers that support a posterior.

    Besides ``requires``, a sampler may declare ``needs_gradient``, ``largest_dim`` and a static
    method ``draws_from(posterior)``.
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
    """Return the classes of all registered samplers that have default settings, by name.

    Samplers that cannot be imported or constructed are skipped with a warning.
    """
    errors: dict[str, ValueError] = {}
    samplers = _imported(errors)
    for name in list(samplers):
        try:
            default_sampler(name)
        except ValueError as error:
            errors[name] = error
            del samplers[name]
    for reason in errors.values():
        warnings.warn(f"{reason}; sampler skipped", stacklevel=2)
    return samplers


def _imported(errors: dict[str, ValueError]) -> dict[str, type[Any]]:
    """Return the importable samplers; add import errors by name to ``errors``."""
    samplers = {}
    for name in sampler_names():
        try:
            samplers[name] = load_sampler(name)
        except ValueError as error:
            errors[name] = error
    return samplers


@cache
def _registered() -> dict[str, EntryPoint]:
    """Return the entry points by name; those of probmotion take precedence."""
    registered: dict[str, EntryPoint] = {}
    points = entry_points(group="probmotion.samplers")
    for point in sorted(points, key=lambda point: _package_of(point) != "the package probmotion"):
        first = registered.setdefault(point.name, point)
        if first.value != point.value:
            warnings.warn(
                f"sampler {point.name!r} of {_package_of(point)} is skipped: "
                f"{_package_of(first)} registers the same name",
                stacklevel=3,
            )
    return registered


def _package_of(point: EntryPoint) -> str:
    return f"the package {point.dist.name}" if point.dist else "a package without a name"


def sampler_names() -> list[str]:
    """Return the names of all samplers registered in the entry-point group probmotion.samplers."""
    return list(_registered())


def load_sampler(name: str) -> type[Any]:
    """Return the class of a registered sampler; raise ``ValueError`` if it cannot be imported."""
    known = _registered()
    if name not in known:
        hint = did_you_mean(name, known)
        raise ValueError(f"sampler must be one of {', '.join(sorted(known))}, got {name!r}{hint}")
    point = known[name]
    try:
        return point.load()
    except Exception as error:  # third-party packages may raise any exception
        raise ValueError(
            f"sampler {name!r} of {_package_of(point)} must be importable from {point.value!r}, "
            f"got {_in_a_line(error)}"
        ) from error


def default_sampler(name: str) -> Any:
    """Return a registered sampler with its default settings; raise ``ValueError`` on failure."""
    kind = load_sampler(name)
    try:
        return kind()
    except Exception as error:
        raise ValueError(
            f"sampler {name!r} must have default settings, got {_in_a_line(error)}; pass an object "
            "with settings"
        ) from error


def _in_a_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


@contextmanager
def progress_bar(total: int, label: str, show: bool) -> Iterator[Any]:
    """Show a progress bar on standard error; yield an object with ``update(n)``."""
    if not show:
        # Even a disabled bar of tqdm creates a semaphore, which worker processes do not release.
        yield SimpleNamespace(update=lambda n=1: None)
        return
    from tqdm import tqdm

    with tqdm(total=total, desc=label, leave=False, dynamic_ncols=True) as bar:
        yield bar


def batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Yield ``items`` in order, at most ``size`` at a time."""
    for start in range(0, len(items), size):
        yield items[start : start + size]

"""Fingerprints distinguish different values and recognise equal ones."""

from __future__ import annotations

import copy
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from decimal import Decimal
from functools import cached_property, lru_cache, partial, update_wrapper, wraps
from multiprocessing import get_context
from pathlib import Path
from threading import Lock

import numpy as np
import pytest
import torch
from scipy.stats import expon, norm
from toy_samplers import Holder, Plain, PriorDraws, generation, monocular

from probmotion.comparison.results import fingerprint as fingerprints
from probmotion.comparison.results.fingerprint import fingerprint


def scaled(noise):
    """Return a nested function with default values."""

    def log_density(x, *, power=2):
        return sum(-((each / noise) ** power) for each in x[..., 0])

    return log_density


def counting(n):
    """Return a function that calls itself."""

    def count(k):
        return 0 if k == n else 1 + count(k + 1)

    return count


def unfinished():
    """Return a function that reads an unassigned variable."""

    def read():
        return later

    if Slotted is None:
        later = 1
    return read


def with_attributes(function, **attributes):
    """Return the function with attributes."""
    vars(function).update(attributes)
    return function


class Prior:
    """Object with methods."""

    def __init__(self, noise):
        self.noise = noise

    def log_density(self, x):
        return -((x / self.noise) ** 2)

    @lru_cache  # noqa: B019
    def known(self):
        return self.noise

    @classmethod
    def named(cls):
        return cls.__name__

    @cached_property
    def half(self):
        return self.noise / 2


class Wrapper:
    """Decorator with a number and the name of its function."""

    def __init__(self, function, noise):
        update_wrapper(self, function)
        self.noise = noise

    def __call__(self, x):
        return self.__wrapped__(x) / self.noise


MARKER = object()


def functions():
    """Return different functions, most of them with the same names."""
    return [
        *(scaled(0.1), scaled(0.2), scaled(np.array(0.2)), counting(1), counting(2), unfinished()),
        *(lambda x: x, lambda x: 2 * x, lambda x: 3 * x, lambda x: abs(x), lambda x: all(x)),
        *(lambda *x: x, lambda x, y: x - y, lambda y, x: x - y, lambda x, y: y - x),
        *(lambda x=1: x, lambda x=2: x, lambda *, x=1: x, lambda *, x=2: x, lambda *, y=2: y),
        *(lambda x: x[..., :1], lambda x: x * 1j, lambda x: x in {"a", "b", "c", "d"}),
        *((lambda: lambda: 1), (lambda: lambda: 2)),
        *(Prior(1).log_density, Prior(2).log_density, Prior(1).known, Prior(2).known),
        *(Prior.log_density, Prior.named, Prior, [].append, [1].append, "a".upper, str.upper),
        *(partial(scaled(1), 1), partial(scaled(2), 1), partial(scaled(2), 2)),
        *(lru_cache(scaled(1)), lru_cache(scaled(2)), wraps(scaled(1))(scaled(2))),
        *(with_attributes(scaled(1), noise=1), with_attributes(scaled(1), noise=2)),
        *(Wrapper(scaled(1), 1), Wrapper(scaled(1), 2), Wrapper(scaled(2), 2)),
        *(np.sin, np.cos, np.mean, torch.sin, torch.cos, np.add.reduce, np.maximum.reduce),
        *(norm.logpdf, norm.cdf, expon.logpdf, partial(norm.logpdf, scale=2), np.random.normal),
        *(lambda x, y=MARKER: x if y else y, lambda x, *, y=MARKER: x if y else y),
        *(np, torch, slice(1), slice(2), 1j, Network),
    ]


class Slotted:
    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value


class Network(torch.nn.Module):
    def __init__(self, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.layer = torch.nn.Linear(2, 2)


def problems():
    """Return problems that differ in the noise, the truth or the observations."""
    problem = monocular()
    noisier = replace(problem.posterior.likelihood, noise=0.06)
    posterior = replace(problem.posterior, likelihood=noisier)
    moved = replace(problem, truth=problem.truth + 1e-9)
    return [problem, replace(problem, posterior=posterior), moved, generation()]


DIFFERENT = [
    *(None, True, 1, 1.0, "1", b"1", [1], (1,), [[1], []], [[], [1]]),
    *({"a": 1}, {"a": 2}, {1, 2}, {"north", "east", "south", "west"}),
    *(np.array([1.0]), np.array([[1.0]]), np.array([1.0], dtype=np.float32), np.float64(1.0)),
    *(torch.tensor([1.0]), Holder(1), Holder(2), Holder(Holder(1)), Plain(1), Plain(2), Plain),
    *(len, partial(int, "1"), partial(int, "2"), Path("a"), Path("b")),
    *(Slotted(1), Slotted(2), Network(0), Network(1), *problems()),
    *(PriorDraws(), PriorDraws(spread=1.1), torch.device("cpu"), torch.device("meta")),
    *(torch.float32, torch.float64, np.dtype("f4"), np.dtype("f8"), range(3), range(4)),
    *(Decimal("1.5"), Decimal("1.6"), deque([1, 2]), deque([2, 1])),
    *(np.array([[1], "a"], dtype=object), np.array([[2], "a"], dtype=object)),
]


def fingerprints_of_all():
    return [fingerprint(value) for value in (*DIFFERENT, *functions())]


def test_different_values_and_functions_have_different_fingerprints():
    digests = fingerprints_of_all()
    assert [k for k, digest in enumerate(digests) if digest in digests[:k]] == []
    # The same in a process with another seed of Python's hashes.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(fingerprints_of_all).result() == digests


@pytest.mark.parametrize("value", DIFFERENT, ids=range(len(DIFFERENT)))
def test_copies_have_the_same_fingerprint(value):
    assert fingerprint(copy.deepcopy(value)) == fingerprint(value)


def test_position_and_specialisation_of_a_function_do_not_count():
    source = "def f(x):\n    return [each + 0.5 for each in x]\n"
    digests = set()
    for file, above in (("one", ""), ("another", "\n\n")):
        space = {"__name__": "somewhere"}
        exec(compile(above + source, file, "exec"), space)
        digests.add(fingerprint(space["f"]))
        for _ in range(1000):  # until Python specialises its bytecode
            space["f"]([1.0, 2.0])
        digests.add(fingerprint(space["f"]))
    assert len(digests) == 1


def test_cyclic_objects_have_fingerprints():
    nodes = [Prior(1), Prior(1), Prior(2)]
    for node in nodes:
        node.step = node.log_density
    one, again, other = map(fingerprint, nodes)
    assert one == again != other
    node = Plain(1)
    node.value = [node]
    assert fingerprint(node) != fingerprint(Plain([1]))


def test_caches_and_order_do_not_count():
    holder = Holder(1)
    before = fingerprint(holder)
    holder.cache["filled"] = 1
    assert fingerprint(holder) == before
    prior = Prior(3.0)
    assert prior.half == 1.5
    assert fingerprint(prior) == fingerprint(Prior(3.0))
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    problem = monocular()
    fresh = fingerprint(problem)
    problem.reference(0, 3)
    assert fingerprint(problem) == fresh == fingerprint(monocular())


GENERATOR = np.random.default_rng(0)


@pytest.mark.parametrize(
    "value",
    [Lock(), GENERATOR, object(), (x for x in "a"), scaled(GENERATOR), GENERATOR.normal],
)
def test_objects_without_content_raise(value):
    with pytest.raises(ValueError, match="value must contain only numbers, strings, arrays"):
        fingerprint([value])


def test_methods_count_for_user_classes_but_not_for_installed_ones(monkeypatch):
    def of(factor):
        """Return an object of a class with edited methods."""

        class Mine:
            width = property(lambda self: factor)

            def sample(self):
                return [2.0] if factor == 3 else [factor]

            @staticmethod
            def name():
                return "mine"

        return Mine()

    class Subclass(type(of(1))):
        pass

    assert fingerprint(of(1)) == fingerprint(of(1))
    assert fingerprint(of(1)) != fingerprint(of(2))
    before = fingerprint(Subclass())
    monkeypatch.setattr(Subclass.__mro__[1], "name", staticmethod(lambda: "other"))
    assert fingerprint(Subclass()) != before
    before = fingerprint(norm)
    monkeypatch.setattr(type(norm), "_pdf", lambda self, x: x)
    assert fingerprint(norm) == before


SCRIPT = """
import functools
import numpy as np

SHIFT, TABLE = 1.0, np.zeros(3)
seen = []

def helper(x):
    seen.append(x)
    return innermost(x) + SHIFT if x else helper(x)

def innermost(x):
    return [each + TABLE for each in x]

@functools.cache
def doubled(x):
    return 2 * x

class Part:
    width = 3.0

    def area(self):
        return doubled(self.width)

class Mine:
    def __init__(self):
        self.calls = 0

    def sample(self, x):
        return helper(Part().area())

def density(x):
    return helper(x)
"""


@pytest.mark.parametrize("expression", ["Mine()", "density"])
def test_globals_that_user_functions_read_count(expression):
    def of(source, before=()):
        space = {"__name__": "a_script"}
        exec(compile(source, "script.py", "exec"), space)
        space["seen"] += before
        return fingerprint(eval(expression, space))

    changes = [("1.0", "0.0"), ("zeros", "ones"), ("each + T", "each - T")]
    changes += [("innermost(x) +", "x +")]
    if expression == "Mine()":
        changes += [("3.0", "4.0"), ("2 * x", "3 * x"), ("doubled(self", "abs(self")]
    digests = [of(SCRIPT), *(of(SCRIPT.replace(*change)) for change in changes)]
    assert len(set(digests)) == len(digests)
    # Lists may fill during a run, and unused variables do not matter.
    assert of(SCRIPT, before=[1]) == of(SCRIPT + "\nother = 5\n") == digests[0]


def test_versions_of_installed_packages_count(monkeypatch):
    from tqdm import tqdm

    values = [[tqdm], [tqdm.format_num], [tqdm([], disable=True)]]
    before = [fingerprint(value) for value in values]
    monkeypatch.setattr(fingerprints, "version", lambda name: "0.0")
    fingerprints._installed_version.cache_clear()
    assert not set(before) & {fingerprint(value) for value in values}
    fingerprints._installed_version.cache_clear()

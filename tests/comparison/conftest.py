"""A small grid that several tests read."""

from __future__ import annotations

import pytest
from toy_samplers import SMALL, Failing, PriorDraws, generation, monocular

from probmotion.comparison import compare
from probmotion.samplers import ExactSampler


@pytest.fixture(scope="session")
def samplers():
    return {"exact": ExactSampler(), "wide": PriorDraws(2.0), "crashing": Failing(how="raise")}


@pytest.fixture(scope="session")
def grid(samplers, tmp_path_factory):
    """Three samplers on two problems with two seeds; do not change its folder."""
    out = tmp_path_factory.mktemp("grid")
    return compare([generation(), monocular()], samplers, seeds=2, out=out, **SMALL)

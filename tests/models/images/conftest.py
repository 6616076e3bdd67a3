"""Fixtures of images."""

from __future__ import annotations

import pytest

from tests.models.images.bodies import small_quadruped


@pytest.fixture(scope="session")
def category():
    return small_quadruped()

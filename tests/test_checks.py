"""What checks accept and what they say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from probmotion.validation import check_count, check_finite, check_positive, check_shape


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((4, 3), ("L", 3)),
        ((0, 3), ("L", 3)),
        ((4, 3), ("…", 3)),
        ((3,), ("…", 3)),
        ((2, 5, 4, 3), ("…", "L", 3)),
        ((), ()),
        ((7,), ("n",)),
    ],
)
def test_shapes_that_fit(shape: tuple[int, ...], expected: tuple[Any, ...]) -> None:
    check_shape("x", np.zeros(shape), expected)


@pytest.mark.parametrize(
    ("shape", "expected", "message"),
    [
        ((4, 2), ("L", 3), r"x must have shape \(L, 3\), got \(4, 2\)"),
        ((2, 4, 3), ("L", 3), r"x must have shape \(L, 3\), got \(2, 4, 3\)"),
        ((3,), ("…", "L", 3), r"x must have shape \(…, L, 3\), got \(3,\)"),
        ((), ("…", 3), r"x must have shape \(…, 3\), got \(\)"),
        ((2, 2), ("…", 2, 3), r"x must have shape \(…, 2, 3\), got \(2, 2\)"),
    ],
)
def test_shapes_that_do_not_fit(
    shape: tuple[int, ...], expected: tuple[Any, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        check_shape("x", np.zeros(shape), expected)


def test_numbers_that_are_not_finite_are_counted_and_found(library: Any) -> None:
    check_finite("x", library.array(np.zeros((2, 3))))
    check_finite("x", library.array(np.zeros((0, 3))))
    values = np.zeros((2, 3))
    values[1, 1:] = [np.nan, -np.inf]
    wanted = r"x must be finite, got 2 values that are NaN or infinite, the first at index \(1, 1\), expected finite"
    with pytest.raises(ValueError, match=wanted):
        check_finite("x", library.array(values))


def test_positive_numbers() -> None:
    check_positive("x", 1e-300)
    for bad in (0, -1, np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match=r"x must be a finite number above 0, got .*"):
            check_positive("x", bad)


def test_counts() -> None:
    check_count("n", 1)
    check_count("n", np.int64(3), least=3)
    check_count("n", 0, least=0)
    for bad in (0, -1, 1.0, True, "3", None):
        with pytest.raises(ValueError, match=r"n must be an integer of at least 1, got .*"):
            check_count("n", bad)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="n must be an integer of at least 3, got 2"):
        check_count("n", 2, least=3)

"""Validation of arguments: accepted values and messages."""

import numpy as np
import pytest

from probmotion.validation import (
    check_count,
    check_finite,
    check_not_negative,
    check_positive,
    check_shape,
)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((0, 3), ("L", 3)), ((3,), ("…", 3)), ((2, 5, 4, 3), ("…", "L", 3)), ((), ())],
)
def test_valid_shapes_are_accepted(shape, expected):
    check_shape("x", np.zeros(shape), expected)


@pytest.mark.parametrize(
    ("shape", "expected", "message"),
    [
        ((4, 2), ("L", 3), r"x must have shape \(L, 3\), got \(4, 2\)"),
        ((2, 4, 3), ("L", 3), r"x must have shape \(L, 3\), got \(2, 4, 3\)"),
        ((3,), ("…", "L", 3), r"x must have shape \(…, L, 3\), got \(3,\)"),
        ((), ("…", 3), r"x must have shape \(…, 3\), got \(\)"),
    ],
)
def test_invalid_shapes_are_refused(shape, expected, message):
    with pytest.raises(ValueError, match=message):
        check_shape("x", np.zeros(shape), expected)


def test_nonfinite_values_are_counted_and_located(library):
    check_finite("x", library.array(np.zeros((2, 3))))
    check_finite("x", library.array(np.zeros((0, 3))))
    values = np.zeros((2, 3))
    values[1, 1:] = [np.nan, -np.inf]
    message = r"x must be finite, got 2 values .* NaN or infinite, the first at index \(1, 1\)"
    with pytest.raises(ValueError, match=message):
        check_finite("x", library.array(values))


def test_invalid_numbers_are_refused():
    check_positive("x", 1e-300)
    for value in (0, -1, np.nan, np.inf, 10**400, True, "1"):
        with pytest.raises(ValueError, match=r"x must be a finite number above 0, got .*"):
            check_positive("x", value)
    check_not_negative("x", 0)
    check_not_negative("x", np.float32(0.5))
    for value in (-1e-300, np.nan, np.inf, 10**400, True, "1"):
        with pytest.raises(ValueError, match=r"x must be a finite number of at least 0, got .*"):
            check_not_negative("x", value)
    check_count("n", np.int64(3), least=3)
    for value, least in ((0, 1), (1.0, 1), (True, 1), ("3", 1), (None, 1), (2, 3)):
        with pytest.raises(ValueError, match=f"n must be an integer of at least {least}, got "):
            check_count("n", value, least)

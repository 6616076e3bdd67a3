"""Joining of windows: what is held in memory, and errors."""

import gc
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from probmotion.lifting.windows import stitched

LENGTH, STEP = 8, 2
STARTS = list(range(0, 200, LENGTH // 2))
ALIVE = weakref.WeakSet()
FRAMES = (STARTS[-1] + LENGTH) * STEP


class Window:
    """Posterior whose motions stand at one place."""

    def __init__(self, place):
        self.prior = SimpleNamespace(frames=LENGTH)
        self.summary = self.place = place
        ALIVE.add(self)

    def mean(self, times):
        return np.full((len(times), 14, 3), float(self.place))

    def sample(self, rng, n, times, joined=None, earlier=None):
        return np.repeat(self.mean(times)[None], n, axis=0)


@pytest.mark.usefixtures("few_objects")
def test_windows_are_averaged_and_released():
    most = []

    def update():
        gc.collect()
        most.append(len(ALIVE))

    mean, draws, summaries = stitched(Window, STARTS, STEP, FRAMES, 3, 0, update)
    assert len(most) == len(STARTS)
    assert max(most) <= 6
    assert summaries == STARTS
    # Weights fall linearly to 0 at a window's ends, and draws change in the middle of the overlap.
    assert np.all(np.diff(mean[:, 0, 0]) >= 0)
    assert set(draws[0, :, 0, 0]) == set(map(float, STARTS))


def test_an_error_ends_the_computation():
    called = []

    def posterior(start):
        called.append(start)
        if start == STARTS[3]:
            raise ValueError("window 3")
        return Window(start)

    with pytest.raises(ValueError, match="window 3"):
        stitched(posterior, STARTS, STEP, FRAMES, 3, 0, lambda: None)
    assert len(called) <= 8

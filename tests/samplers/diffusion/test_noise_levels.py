"""Noise levels: ranges, numbers of levels, and objects that are not levels or integrators."""

from __future__ import annotations

import pytest

from probmotion.samplers import Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector
from probmotion.samplers.diffusion import Cosine, Karras, LogSNR, StochSync
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D

DEFAULT_RANGE = "use smallest=0.004, largest=80"
LEVELS = r"levels must be Cosine\(\), Karras\(\) or LogSNR\(\)"
INTEGRATORS = r"integrator must be DDPM\(\), DDIM\(\), SecondOrderSDE\(\) or Heun\(\)"


@pytest.mark.parametrize("levels", [Karras(), LogSNR()])
def test_a_range_has_at_least_two_levels(levels):
    """One level would be the smallest, at which the state is not pure noise."""
    for steps in (1, 0, 1.5):
        with pytest.raises(ValueError, match="steps must be an integer of at least 2"):
            levels.schedule(steps)
    with pytest.raises(ValueError, match="steps must be an integer of at least 2, got 1"):
        Ancestral3D(steps=1, levels=levels)
    assert levels.schedule(2).sigma(2) == pytest.approx(80)
    assert Cosine().schedule(1).sigma(1) > 30


@pytest.mark.parametrize("kind", [Karras, LogSNR])
@pytest.mark.parametrize("smallest", [80.0, 100.0])
def test_limits_in_the_wrong_order_are_refused(kind, smallest):
    message = f"smallest must be below largest, 80, got {smallest:g}; {DEFAULT_RANGE}"
    with pytest.raises(ValueError, match=message):
        kind(smallest=smallest)


@pytest.mark.parametrize(
    "levels",
    [Karras(smallest=1e-9), LogSNR(smallest=1e-9), Karras(rho=1e20), Karras(rho=1e-3)],
)
def test_a_schedule_that_does_not_fall_is_refused(levels):
    message = f"noise must increase with every level, got 20 levels between .*; {DEFAULT_RANGE}"
    with pytest.raises(ValueError, match=message):
        Ancestral3D(steps=20, levels=levels)


def test_a_power_that_underflows_is_refused():
    with pytest.raises(ValueError, match=r"got 1\.8.*e-111, nan from level 45; use .* power 2"):
        Ancestral3D(levels=Cosine(power=400))


@pytest.mark.parametrize(
    "sampler",
    [Ancestral2D, Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector, StochSync],
)
@pytest.mark.parametrize("levels", ["karras", Karras, None])
def test_names_of_levels_are_refused(sampler, levels):
    with pytest.raises(ValueError, match=f"{LEVELS}, got "):
        sampler(levels=levels)


@pytest.mark.parametrize(
    "sampler", [Ancestral2D, Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector]
)
def test_names_of_integrators_are_refused(sampler):
    with pytest.raises(ValueError, match=f"{INTEGRATORS}, got 'heun'"):
        sampler(integrator="heun")

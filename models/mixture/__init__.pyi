from .conditioned_mixture import ConditionedMixture as ConditionedMixture
from .fit import (
    FittedStyles as FittedStyles,
    cut_windows as cut_windows,
    fit_styles as fit_styles,
    turn_to as turn_to,
)
from .gaussian_mixture import GaussianMixtureMotion as GaussianMixtureMotion
from .posterior import MixturePosterior as MixturePosterior
from .turned_mixture import (
    TurnedMixture as TurnedMixture,
    turning_coefficients as turning_coefficients,
    turning_fields as turning_fields,
)

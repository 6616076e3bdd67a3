from .conditioned_mixture import ConditionedMixture as ConditionedMixture
from .fit import (
    FittedStyles as FittedStyles,
)
from .fit import (
    cut_windows as cut_windows,
)
from .fit import (
    fit_styles as fit_styles,
)
from .fit import (
    turn_to as turn_to,
)
from .gaussian_mixture import GaussianMixtureMotion as GaussianMixtureMotion
from .posterior import MixturePosterior as MixturePosterior
from .turned_mixture import (
    TurnedMixture as TurnedMixture,
)
from .turned_mixture import (
    turning_coefficients as turning_coefficients,
)
from .turned_mixture import (
    turning_fields as turning_fields,
)

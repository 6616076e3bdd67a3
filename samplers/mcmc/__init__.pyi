from .autocorrelation import autocorrelation_time as autocorrelation_time
from .ensemble import Ensemble as Ensemble
from .metropolis import MetropolisHastings as MetropolisHastings
from .nuts import NUTS as NUTS
from .proposals import (
    AdaptiveCovariance as AdaptiveCovariance,
    Isotropic as Isotropic,
    Proposal as Proposal,
    VelocityBiased as VelocityBiased,
)

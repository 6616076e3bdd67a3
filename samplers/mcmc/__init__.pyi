from .autocorrelation import autocorrelation_time as autocorrelation_time
from .ensemble import Ensemble as Ensemble
from .metropolis import MetropolisHastings as MetropolisHastings
from .nuts import NUTS as NUTS
from .nuts_kernel import CHUNK as CHUNK, NutsKernel as NutsKernel, compiled as compiled
from .proposals import (
    AdaptiveCovariance as AdaptiveCovariance,
    Isotropic as Isotropic,
    Proposal as Proposal,
    ProposalState as ProposalState,
    VelocityBiased as VelocityBiased,
)

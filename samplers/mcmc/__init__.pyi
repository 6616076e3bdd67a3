from .autocorrelation import autocorrelation_time as autocorrelation_time
from .ensemble import Ensemble as Ensemble
from .metropolis import MetropolisHastings as MetropolisHastings
from .nuts import NUTS as NUTS
from .nuts_kernel import CHUNK as CHUNK
from .nuts_kernel import NutsKernel as NutsKernel
from .nuts_kernel import compiled as compiled
from .proposals import (
    AdaptiveCovariance as AdaptiveCovariance,
)
from .proposals import (
    Isotropic as Isotropic,
)
from .proposals import (
    Proposal as Proposal,
)
from .proposals import (
    ProposalState as ProposalState,
)
from .proposals import (
    VelocityBiased as VelocityBiased,
)

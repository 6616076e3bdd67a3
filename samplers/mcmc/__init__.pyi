from .autocorrelation import autocorrelation_time as autocorrelation_time
from .ensemble import Ensemble as Ensemble
from .function import FunctionSampler as FunctionSampler, TargetDensity as TargetDensity
from .libraries import (
    blackjax_kernel as blackjax_kernel,
    emcee_sampler as emcee_sampler,
    flowmc_sampler as flowmc_sampler,
    numpyro_kernel as numpyro_kernel,
)
from .metropolis import MetropolisHastings as MetropolisHastings
from .nuts import NUTS as NUTS
from .proposals import (
    AdaptiveCovariance as AdaptiveCovariance,
    Isotropic as Isotropic,
    Proposal as Proposal,
    VelocityBiased as VelocityBiased,
)
from .smc import SequentialMonteCarlo as SequentialMonteCarlo
from .tempered import ParallelTempering as ParallelTempering
from .tempered_pairs import TemperedPairs as TemperedPairs

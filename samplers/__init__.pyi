from .conditional.split_gibbs import SplitGibbs as SplitGibbs
from .diffusion.ancestral3d import Ancestral3D as Ancestral3D
from .diffusion.mas import MultiViewAncestral as MultiViewAncestral
from .diffusion.mvpc import MultiViewPredictorCorrector as MultiViewPredictorCorrector
from .diffusion.sds import ScoreDistillation as ScoreDistillation
from .exact import ExactSampler as ExactSampler
from .mcmc.ensemble import Ensemble as Ensemble
from .mcmc.function import FunctionSampler as FunctionSampler
from .mcmc.libraries import (
    blackjax_kernel as blackjax_kernel,
    emcee_sampler as emcee_sampler,
    flowmc_sampler as flowmc_sampler,
    numpyro_kernel as numpyro_kernel,
)
from .mcmc.metropolis import MetropolisHastings as MetropolisHastings
from .mcmc.nuts import NUTS as NUTS
from .mcmc.smc import SequentialMonteCarlo as SequentialMonteCarlo
from .mcmc.tempered import ParallelTempering as ParallelTempering
from .mcmc.tempered_pairs import TemperedPairs as TemperedPairs
from .variational.dvae import DVAEInference as DVAEInference

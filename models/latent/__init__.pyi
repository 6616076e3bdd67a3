from .reduced_latent import ReducedLatent as ReducedLatent
from .standard_normal import StandardNormalPrior as StandardNormalPrior

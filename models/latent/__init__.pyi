from .code_mixture import CodeMixture as CodeMixture, CodePrior as CodePrior
from .reduced_latent import ReducedLatent as ReducedLatent
from .standard_normal import StandardNormalPrior as StandardNormalPrior

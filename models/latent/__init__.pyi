from .reduced_latent import ReducedLatent as ReducedLatent
from .row_decoding import decode_rows as decode_rows
from .standard_normal import StandardNormalPrior as StandardNormalPrior

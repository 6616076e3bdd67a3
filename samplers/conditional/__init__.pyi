from .daps import DAPS as DAPS
from .red_diff import REDDiff as REDDiff
from .split_gibbs import SplitGibbs as SplitGibbs
from .twisted import TwistedDiffusion as TwistedDiffusion

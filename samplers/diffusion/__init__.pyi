from .ancestral2d import Ancestral2D as Ancestral2D
from .ancestral3d import Ancestral3D as Ancestral3D
from .guidance import (
    DPS as DPS,
    AnyGuidance as AnyGuidance,
    ExactGuidance as ExactGuidance,
    MomentMatched as MomentMatched,
    Replacement as Replacement,
    WeightedTriangulation as WeightedTriangulation,
)
from .integrators import (
    DDIM as DDIM,
    DDPM as DDPM,
    AnyIntegrator as AnyIntegrator,
    Heun as Heun,
    SecondOrderSDE as SecondOrderSDE,
)
from .mas import MultiViewAncestral as MultiViewAncestral, MultiViewTrace as MultiViewTrace
from .mvpc import MultiViewPredictorCorrector as MultiViewPredictorCorrector
from .noise_levels import (
    AnyLevels as AnyLevels,
    Cosine as Cosine,
    Karras as Karras,
    LogSNR as LogSNR,
)
from .sds import ScoreDistillation as ScoreDistillation
from .stoch_sync import StochSync as StochSync
from .sync_tweedies import SyncTweedies as SyncTweedies

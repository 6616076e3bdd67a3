from .ancestral2d import Ancestral2D as Ancestral2D
from .ancestral3d import Ancestral3D as Ancestral3D
from .guidance import (
    DPS as DPS,
    AnyGuidance as AnyGuidance,
    MomentMatched as MomentMatched,
    Replacement as Replacement,
    WeightedTriangulation as WeightedTriangulation,
)
from .mas import MultiViewAncestral as MultiViewAncestral, MultiViewTrace as MultiViewTrace
from .mvpc import MultiViewPredictorCorrector as MultiViewPredictorCorrector
from .sds import ScoreDistillation as ScoreDistillation

from .ancestral import (
    Corrector as Corrector,
    Guide as Guide,
    MotionState as MotionState,
    State as State,
    StateDenoiser as StateDenoiser,
    Watch as Watch,
    cosine_schedule as cosine_schedule,
    sigma as sigma,
)
from .ancestral2d import Ancestral2D as Ancestral2D
from .ancestral3d import Ancestral3D as Ancestral3D
from .coordinate_distillation import (
    coordinate_distillation_gradient as coordinate_distillation_gradient,
    distil_coordinates as distil_coordinates,
)
from .guidance import (
    DPS as DPS,
    AnyGuidance as AnyGuidance,
    Evidence as Evidence,
    MomentMatched as MomentMatched,
    Replacement as Replacement,
    WeightedTriangulation as WeightedTriangulation,
    can_guide as can_guide,
    conjugate_gradients as conjugate_gradients,
    guide_towards as guide_towards,
)
from .mas import MultiViewAncestral as MultiViewAncestral, MultiViewTrace as MultiViewTrace
from .mvpc import MultiViewPredictorCorrector as MultiViewPredictorCorrector
from .sds import (
    ScoreDistillation as ScoreDistillation,
    score_distillation_gradient as score_distillation_gradient,
)
from .separate_views import SeparateViews as SeparateViews
from .views import (
    MotionDenoiser as MotionDenoiser,
    MultiViewDenoiser as MultiViewDenoiser,
    Views as Views,
    symmetric_power as symmetric_power,
    views_around as views_around,
    warn_of_level_views as warn_of_level_views,
)

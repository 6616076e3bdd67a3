from .ancestral import (
    Corrector as Corrector,
)
from .ancestral import (
    Guide as Guide,
)
from .ancestral import (
    MotionState as MotionState,
)
from .ancestral import (
    State as State,
)
from .ancestral import (
    StateDenoiser as StateDenoiser,
)
from .ancestral import (
    Watch as Watch,
)
from .ancestral import (
    cosine_schedule as cosine_schedule,
)
from .ancestral import (
    sigma as sigma,
)
from .ancestral2d import Ancestral2D as Ancestral2D
from .ancestral3d import Ancestral3D as Ancestral3D
from .coordinate_distillation import (
    coordinate_distillation_gradient as coordinate_distillation_gradient,
)
from .coordinate_distillation import (
    distil_coordinates as distil_coordinates,
)
from .guidance import (
    DPS as DPS,
)
from .guidance import (
    AnyGuidance as AnyGuidance,
)
from .guidance import (
    Evidence as Evidence,
)
from .guidance import (
    MomentMatched as MomentMatched,
)
from .guidance import (
    Replacement as Replacement,
)
from .guidance import (
    WeightedTriangulation as WeightedTriangulation,
)
from .guidance import (
    can_guide as can_guide,
)
from .guidance import (
    conjugate_gradients as conjugate_gradients,
)
from .guidance import (
    guide_towards as guide_towards,
)
from .mas import MultiViewAncestral as MultiViewAncestral
from .mas import MultiViewTrace as MultiViewTrace
from .mvpc import MultiViewPredictorCorrector as MultiViewPredictorCorrector
from .sds import (
    ScoreDistillation as ScoreDistillation,
)
from .sds import (
    score_distillation_gradient as score_distillation_gradient,
)
from .separate_views import SeparateViews as SeparateViews
from .views import (
    MotionDenoiser as MotionDenoiser,
)
from .views import (
    MultiViewDenoiser as MultiViewDenoiser,
)
from .views import (
    Views as Views,
)
from .views import (
    symmetric_power as symmetric_power,
)
from .views import (
    views_around as views_around,
)
from .views import (
    warn_of_level_views as warn_of_level_views,
)

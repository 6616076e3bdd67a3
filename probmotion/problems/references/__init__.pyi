from .chains import KeptChain as KeptChain
from .making import (
    ReferenceRefused as ReferenceRefused,
)
from .making import (
    agreement as agreement,
)
from .making import (
    certify as certify,
)
from .making import (
    make_reference as make_reference,
)
from .outlier_gibbs import OutlierGibbs as OutlierGibbs
from .pair_densities import (
    Physics as Physics,
)
from .pair_densities import (
    Sight as Sight,
)
from .pair_densities import (
    judge as judge,
)
from .pair_densities import (
    log_annotations as log_annotations,
)
from .pair_densities import (
    log_measure as log_measure,
)
from .pair_densities import (
    log_penetration as log_penetration,
)
from .pair_densities import (
    log_prior as log_prior,
)
from .pair_densities import (
    log_sketch as log_sketch,
)
from .pair_densities import (
    log_view as log_view,
)
from .pair_densities import (
    log_views as log_views,
)
from .pair_densities import (
    picture_of as picture_of,
)
from .pair_densities import (
    weigh as weigh,
)
from .pair_moves import (
    HINGE as HINGE,
)
from .pair_moves import (
    SHIFT as SHIFT,
)
from .pair_moves import (
    STRETCH as STRETCH,
)
from .pair_moves import (
    TURN as TURN,
)
from .pair_moves import (
    Body as Body,
)
from .pair_moves import (
    log_places as log_places,
)
from .pair_moves import (
    moves_of as moves_of,
)
from .pair_moves import (
    place_anew as place_anew,
)
from .pair_moves import (
    propose as propose,
)
from .pair_walk_kernels import walk as walk
from .store import find_reference as find_reference
from .store import references_folder as references_folder
from .tempered_pairs import TemperedPairs as TemperedPairs

from .chains import StoredChain as StoredChain
from .making import (
    ReferenceRefused as ReferenceRefused,
    agreement as agreement,
    certify as certify,
    make_reference as make_reference,
)
from .outlier_gibbs import OutlierGibbs as OutlierGibbs
from .pair_densities import (
    Physics as Physics,
    Sight as Sight,
    judge as judge,
    log_annotations as log_annotations,
    log_measure as log_measure,
    log_penetration as log_penetration,
    log_prior as log_prior,
    log_sketch as log_sketch,
    log_view as log_view,
    log_views as log_views,
    picture_of as picture_of,
    weigh as weigh,
)
from .pair_moves import (
    HINGE as HINGE,
    SHIFT as SHIFT,
    STRETCH as STRETCH,
    TURN as TURN,
    Body as Body,
    log_places as log_places,
    moves_of as moves_of,
    place_anew as place_anew,
    propose as propose,
)
from .pair_walk_kernels import walk as walk
from .store import find_reference as find_reference, references_folder as references_folder
from .tempered_pairs import TemperedPairs as TemperedPairs

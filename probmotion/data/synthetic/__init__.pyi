from .animals import (
    ANIMAL_SKELETON as ANIMAL_SKELETON,
    DOG_CLIPS as DOG_CLIPS,
    animal_clips as animal_clips,
    dog_clips as dog_clips,
    synthetic_animals as synthetic_animals,
)
from .dances import synthetic_dances as synthetic_dances
from .gaits import GAITS as GAITS, make_gait as make_gait, make_gaits as make_gaits
from .walks import (
    WALK_CLIPS as WALK_CLIPS,
    shared_skeleton as shared_skeleton,
    synthetic_walks as synthetic_walks,
    walk_clips as walk_clips,
)

from .animals import (
    ANIMAL_SKELETON as ANIMAL_SKELETON,
)
from .animals import (
    DOG_CLIPS as DOG_CLIPS,
)
from .animals import (
    animal_clips as animal_clips,
)
from .animals import (
    dog_clips as dog_clips,
)
from .animals import (
    made_animals as made_animals,
)
from .choreography import (
    HOLDS as HOLDS,
)
from .choreography import (
    Dance as Dance,
)
from .choreography import (
    Figure as Figure,
)
from .choreography import (
    draw_dance as draw_dance,
)
from .choreography import (
    level as level,
)
from .choreography import (
    rise as rise,
)
from .cycles import repeated_cycle as repeated_cycle
from .dances import make_dances as make_dances
from .gaits import GAITS as GAITS
from .gaits import make_gait as make_gait
from .gaits import make_gaits as make_gaits
from .limbs import bent_limb as bent_limb
from .limbs import rotated as rotated
from .walks import (
    WALK_CLIPS as WALK_CLIPS,
)
from .walks import (
    made_walks as made_walks,
)
from .walks import (
    shared_skeleton as shared_skeleton,
)
from .walks import (
    walk_clips as walk_clips,
)

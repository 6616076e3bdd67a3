from .annotations import Annotations as Annotations
from .backbones import (
    LEAST_JOINTS as LEAST_JOINTS,
)
from .backbones import (
    BackboneEstimate as BackboneEstimate,
)
from .backbones import (
    annotation_views as annotation_views,
)
from .backbones import (
    lift_torsos as lift_torsos,
)
from .backbones import (
    torso_joints as torso_joints,
)
from .local_frames import (
    SMALLEST_SINE as SMALLEST_SINE,
)
from .local_frames import (
    chests as chests,
)
from .local_frames import (
    cross as cross,
)
from .local_frames import (
    frames_are_sound as frames_are_sound,
)
from .local_frames import (
    pair_frames as pair_frames,
)
from .local_frames import (
    trees as trees,
)
from .local_frames import (
    unit as unit,
)
from .sources import (
    ELEVATIONS as ELEVATIONS,
)
from .sources import (
    DrawnAnnotations as DrawnAnnotations,
)
from .sources import (
    draw_annotations as draw_annotations,
)
from .sources import (
    world_axes as world_axes,
)
from .torso_fits import BodyFit as BodyFit
from .torso_fits import fit_body as fit_body
from .tracks import annotations_of_tracks as annotations_of_tracks
from .views import (
    ViewDistribution as ViewDistribution,
)
from .views import (
    image_axes as image_axes,
)
from .views import (
    project_to_views as project_to_views,
)
from .views import (
    view_angles as view_angles,
)
from .views import (
    view_directions as view_directions,
)
from .views import (
    view_vectors as view_vectors,
)

from .annotations import Annotations as Annotations
from .backbones import (
    LEAST_JOINTS as LEAST_JOINTS,
    BackboneEstimate as BackboneEstimate,
    annotation_views as annotation_views,
    lift_torsos as lift_torsos,
    torso_joints as torso_joints,
)
from .local_frames import (
    SMALLEST_SINE as SMALLEST_SINE,
    chests as chests,
    cross as cross,
    frames_are_sound as frames_are_sound,
    pair_frames as pair_frames,
    trees as trees,
    unit as unit,
)
from .sources import (
    ELEVATIONS as ELEVATIONS,
    DrawnAnnotations as DrawnAnnotations,
    draw_annotations as draw_annotations,
    world_axes as world_axes,
)
from .torso_fits import BodyFit as BodyFit, fit_body as fit_body
from .tracks import annotations_of_tracks as annotations_of_tracks
from .views import (
    ViewDistribution as ViewDistribution,
    image_axes as image_axes,
    project_to_views as project_to_views,
    view_angles as view_angles,
    view_directions as view_directions,
    view_vectors as view_vectors,
)

from .annotations import Annotations as Annotations
from .backbones import (
    BackboneEstimate as BackboneEstimate,
    annotation_views as annotation_views,
    lift_torsos as lift_torsos,
)
from .local_frames import pair_frames as pair_frames
from .sources import DrawnAnnotations as DrawnAnnotations, draw_annotations as draw_annotations
from .tracks import (
    annotations_of_keypoints as annotations_of_keypoints,
    annotations_of_tracks as annotations_of_tracks,
    keypoints_of_tracks as keypoints_of_tracks,
)
from .views import (
    ViewDistribution as ViewDistribution,
    project_to_views as project_to_views,
    view_angles as view_angles,
    view_vectors as view_vectors,
)

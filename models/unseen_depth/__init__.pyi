from .annotation_prior import AnnotationPrior as AnnotationPrior
from .keypoints import AnnotationLifts as AnnotationLifts
from .physical_lift import PhysicalLift as PhysicalLift
from .physical_lifting import physical_lifts as physical_lifts
from .pose_depth import PoseDepth as PoseDepth
from .smoothing import SmoothedLifts as SmoothedLifts, smoothed_lifts as smoothed_lifts
from .track_prior import motion_prior_from_tracks as motion_prior_from_tracks

from .joints import (
    nearest_object as nearest_object,
    retarget_track as retarget_track,
    with_joint as with_joint,
    with_midpoint as with_midpoint,
)
from .learning import (
    LearningTracks as LearningTracks,
    certain as certain,
    film_clips as film_clips,
    film_windows as film_windows,
    read_tracks as read_tracks,
    split_tracks as split_tracks,
)
from .poses import mirrored_track as mirrored_track
from .preparation import PreparedTracks as PreparedTracks, prepare_tracks as prepare_tracks
from .scales import bone_sizes as bone_sizes, scale_to_bones as scale_to_bones
from .step_reports import StepReport as StepReport

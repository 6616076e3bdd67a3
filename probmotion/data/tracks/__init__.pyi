from .filters import (
    drop_crowds as drop_crowds,
    drop_low_quality as drop_low_quality,
    drop_short as drop_short,
    hide_strays as hide_strays,
    hide_uncertain as hide_uncertain,
)
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
    synthetic_walks as synthetic_walks,
)
from .poses import (
    centre_tracks as centre_tracks,
    mirror_tracks as mirror_tracks,
    mirrored_track as mirrored_track,
)
from .preparation import PreparedTracks as PreparedTracks, prepare_tracks as prepare_tracks
from .scale_reports import body_extent as body_extent, per_track_scales as per_track_scales
from .scales import bone_sizes as bone_sizes, scale_to_bones as scale_to_bones
from .segments import split_discontinuities as split_discontinuities, track_size as track_size
from .smoothing import (
    fill_gaps as fill_gaps,
    resample_tracks as resample_tracks,
    smooth_tracks as smooth_tracks,
)
from .step_reports import (
    StepReport as StepReport,
    entries_of as entries_of,
    frames_of as frames_of,
    seen as seen,
)

from .filters import (
    drop_crowds as drop_crowds,
)
from .filters import (
    drop_low_quality as drop_low_quality,
)
from .filters import (
    drop_short as drop_short,
)
from .filters import (
    hide_strays as hide_strays,
)
from .filters import (
    hide_uncertain as hide_uncertain,
)
from .joints import (
    nearest_object as nearest_object,
)
from .joints import (
    retarget_track as retarget_track,
)
from .joints import (
    with_joint as with_joint,
)
from .joints import (
    with_midpoint as with_midpoint,
)
from .learning import (
    LearningTracks as LearningTracks,
)
from .learning import (
    certain as certain,
)
from .learning import (
    film_clips as film_clips,
)
from .learning import (
    film_windows as film_windows,
)
from .learning import (
    made_walks as made_walks,
)
from .learning import (
    read_tracks as read_tracks,
)
from .learning import (
    split_tracks as split_tracks,
)
from .poses import (
    centre_tracks as centre_tracks,
)
from .poses import (
    mirror_tracks as mirror_tracks,
)
from .poses import (
    mirrored_track as mirrored_track,
)
from .preparation import PreparedTracks as PreparedTracks
from .preparation import prepare_tracks as prepare_tracks
from .scale_reports import body_extent as body_extent
from .scale_reports import own_sizes as own_sizes
from .scales import bone_sizes as bone_sizes
from .scales import scale_to_bones as scale_to_bones
from .segments import split_discontinuities as split_discontinuities
from .segments import track_size as track_size
from .smoothing import (
    fill_gaps as fill_gaps,
)
from .smoothing import (
    resample_tracks as resample_tracks,
)
from .smoothing import (
    smooth_tracks as smooth_tracks,
)
from .step_reports import (
    StepReport as StepReport,
)
from .step_reports import (
    entries_of as entries_of,
)
from .step_reports import (
    frames_of as frames_of,
)
from .step_reports import (
    seen as seen,
)

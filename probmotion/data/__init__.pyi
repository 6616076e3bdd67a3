from .cmu_clips import cmu_clip as cmu_clip
from .denoising_clips import (
    DENOISING_CLIPS as DENOISING_CLIPS,
)
from .denoising_clips import (
    made_denoising_clips as made_denoising_clips,
)
from .downloads import (
    CMU_ACKNOWLEDGEMENT as CMU_ACKNOWLEDGEMENT,
)
from .downloads import (
    CMU_TERMS as CMU_TERMS,
)
from .downloads import (
    SALSA_TRIALS as SALSA_TRIALS,
)
from .downloads import (
    DownloadError as DownloadError,
)
from .downloads import (
    data_folder as data_folder,
)
from .downloads import (
    data_places as data_places,
)
from .downloads import (
    download as download,
)
from .downloads import (
    salsa_pairs as salsa_pairs,
)
from .joint_filters import (
    filled_between as filled_between,
)
from .joint_filters import (
    fit_acceleration as fit_acceleration,
)
from .joint_filters import (
    kalman_smooth as kalman_smooth,
)
from .joint_filters import (
    log_evidence as log_evidence,
)
from .joint_filters import (
    savitzky_golay as savitzky_golay,
)
from .pair_sets import (
    SALSA_HELD_OUT as SALSA_HELD_OUT,
)
from .pair_sets import (
    check_close_people as check_close_people,
)
from .pair_sets import (
    choose_seed as choose_seed,
)
from .pair_sets import (
    dance_frames as dance_frames,
)
from .pair_sets import (
    describe_dance_frames as describe_dance_frames,
)
from .pair_sets import (
    ground_truth as ground_truth,
)
from .pair_sets import (
    hold_out as hold_out,
)
from .pair_sets import (
    person_height as person_height,
)
from .pair_sets import (
    scaled_to_height as scaled_to_height,
)
from .pairs import (
    load_pairs as load_pairs,
)
from .pairs import (
    pair_motion as pair_motion,
)
from .pairs import (
    pair_of as pair_of,
)
from .pairs import (
    read_salsa_bvh as read_salsa_bvh,
)
from .projections import (
    Centre as Centre,
)
from .projections import (
    DetectorNoise as DetectorNoise,
)
from .projections import (
    Filming as Filming,
)
from .projections import (
    centre_motion as centre_motion,
)
from .projections import (
    project_clips as project_clips,
)

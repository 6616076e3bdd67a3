from .cmu_clips import cmu_clip as cmu_clip
from .denoising_clips import (
    DENOISING_CLIPS as DENOISING_CLIPS,
    synthetic_denoising_clips as synthetic_denoising_clips,
)
from .downloads import (
    CMU_ACKNOWLEDGEMENT as CMU_ACKNOWLEDGEMENT,
    CMU_TERMS as CMU_TERMS,
    SALSA_TRIALS as SALSA_TRIALS,
    DownloadError as DownloadError,
    data_folder as data_folder,
    data_places as data_places,
    download as download,
    salsa_pairs as salsa_pairs,
)
from .joint_filters import (
    filled_between as filled_between,
    fit_acceleration as fit_acceleration,
    kalman_smooth as kalman_smooth,
    log_marginal_likelihood as log_marginal_likelihood,
    savitzky_golay as savitzky_golay,
)
from .pair_sets import (
    SALSA_HELD_OUT as SALSA_HELD_OUT,
    check_close_people as check_close_people,
    choose_seed as choose_seed,
    dance_frames as dance_frames,
    describe_dance_frames as describe_dance_frames,
    ground_truth as ground_truth,
    hold_out as hold_out,
    person_height as person_height,
    scaled_to_height as scaled_to_height,
)
from .pairs import (
    load_pairs as load_pairs,
    pair_motion as pair_motion,
    pair_of as pair_of,
    read_salsa_bvh as read_salsa_bvh,
)
from .projections import (
    DetectorNoise as DetectorNoise,
    Filming as Filming,
    centre_motion as centre_motion,
    project_clips as project_clips,
)

from .accuracy import (
    acceleration_error as acceleration_error,
)
from .accuracy import (
    acceleration_ratio as acceleration_ratio,
)
from .accuracy import (
    aligned_by_root as aligned_by_root,
)
from .accuracy import (
    aligned_by_similarity as aligned_by_similarity,
)
from .accuracy import (
    joint_errors as joint_errors,
)
from .accuracy import (
    mean_over as mean_over,
)
from .chains import (
    chain_diagnostics as chain_diagnostics,
)
from .chains import (
    principal_coordinates as principal_coordinates,
)
from .chains import (
    rhat_of_independent as rhat_of_independent,
)
from .chains import (
    watched_coordinates as watched_coordinates,
)
from .cost import costs as costs
from .coverage import (
    nearest_draw_distances as nearest_draw_distances,
)
from .coverage import (
    pose_distances as pose_distances,
)
from .credible_sets import (
    DENSITY as DENSITY,
)
from .credible_sets import (
    DISTANCE as DISTANCE,
)
from .credible_sets import (
    credible_level as credible_level,
)
from .distribution import (
    mean_error as mean_error,
)
from .distribution import (
    precision_recall as precision_recall,
)
from .distribution import (
    random_directions as random_directions,
)
from .distribution import (
    sliced_wasserstein as sliced_wasserstein,
)
from .distribution import (
    sliced_wasserstein_ratio as sliced_wasserstein_ratio,
)
from .distribution import (
    trace_ratio as trace_ratio,
)
from .filming import (
    Angles as Angles,
)
from .filming import (
    film_motions as film_motions,
)
from .filming import (
    random_azimuths as random_azimuths,
)
from .generation import (
    COLLAPSED_BELOW as COLLAPSED_BELOW,
)
from .generation import (
    EncodesViews as EncodesViews,
)
from .generation import (
    GenerationReference as GenerationReference,
)
from .generation import (
    GenerationScores as GenerationScores,
)
from .generation import (
    diversity as diversity,
)
from .generation import (
    frechet_distance as frechet_distance,
)
from .generation import (
    score_features as score_features,
)
from .generation import (
    score_generation as score_generation,
)
from .intervals import best_and_tied as best_and_tied
from .intervals import t_interval as t_interval
from .keypoints import (
    fit_linear_map as fit_linear_map,
)
from .keypoints import (
    percentage_of_correct_keypoints as percentage_of_correct_keypoints,
)
from .keypoints import (
    picture_size as picture_size,
)
from .keypoints import (
    velocity_error as velocity_error,
)
from .measures import measure as measure
from .motion_chamfer import (
    MotionChamfer as MotionChamfer,
)
from .motion_chamfer import (
    motion_chamfer_distance as motion_chamfer_distance,
)
from .stein import (
    NoGradient as NoGradient,
)
from .stein import (
    kernel_stein_discrepancy as kernel_stein_discrepancy,
)
from .stein import (
    score_of as score_of,
)
from .structure import HasManifold as HasManifold
from .structure import HasStyles as HasStyles
from .two_sample import (
    classifier_two_sample as classifier_two_sample,
)
from .two_sample import (
    discrepancy_p_value as discrepancy_p_value,
)
from .two_sample import (
    maximum_mean_discrepancy as maximum_mean_discrepancy,
)
from .two_sample import (
    median_distance as median_distance,
)
from .two_sample import (
    squared_distances as squared_distances,
)
from .uniformity import (
    adjusted_p_values as adjusted_p_values,
)
from .uniformity import (
    ecdf_band as ecdf_band,
)
from .uniformity import (
    evaluation_points as evaluation_points,
)
from .uniformity import (
    uniformity_p_value as uniformity_p_value,
)

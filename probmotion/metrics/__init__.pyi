from .accuracy import (
    acceleration_error as acceleration_error,
    acceleration_ratio as acceleration_ratio,
    aligned_by_root as aligned_by_root,
    aligned_by_similarity as aligned_by_similarity,
    joint_errors as joint_errors,
    mean_over as mean_over,
)
from .chains import (
    chain_diagnostics as chain_diagnostics,
    principal_coordinates as principal_coordinates,
    rhat_of_independent as rhat_of_independent,
    watched_coordinates as watched_coordinates,
)
from .cost import costs as costs
from .coverage import (
    nearest_draw_distances as nearest_draw_distances,
    pose_distances as pose_distances,
)
from .credible_sets import (
    DENSITY as DENSITY,
    DISTANCE as DISTANCE,
    credible_level as credible_level,
)
from .distribution import (
    mean_error as mean_error,
    precision_recall as precision_recall,
    random_directions as random_directions,
    sliced_wasserstein as sliced_wasserstein,
    sliced_wasserstein_ratio as sliced_wasserstein_ratio,
    trace_ratio as trace_ratio,
)
from .filming import (
    Angles as Angles,
    film_motions as film_motions,
    random_azimuths as random_azimuths,
)
from .generation import (
    COLLAPSED_BELOW as COLLAPSED_BELOW,
    EncodesViews as EncodesViews,
    GenerationReference as GenerationReference,
    GenerationScores as GenerationScores,
    diversity as diversity,
    frechet_distance as frechet_distance,
    score_features as score_features,
    score_generation as score_generation,
)
from .intervals import best_and_tied as best_and_tied, t_interval as t_interval
from .keypoints import (
    fit_linear_map as fit_linear_map,
    image_extent as image_extent,
    percentage_of_correct_keypoints as percentage_of_correct_keypoints,
    velocity_error as velocity_error,
)
from .measures import measure as measure
from .motion_chamfer import (
    MotionChamfer as MotionChamfer,
    motion_chamfer_distance as motion_chamfer_distance,
)
from .stein import (
    NoGradient as NoGradient,
    kernel_stein_discrepancy as kernel_stein_discrepancy,
    score_of as score_of,
)
from .structure import HasManifold as HasManifold, HasStyles as HasStyles
from .two_sample import (
    classifier_two_sample as classifier_two_sample,
    discrepancy_p_value as discrepancy_p_value,
    maximum_mean_discrepancy as maximum_mean_discrepancy,
    median_distance as median_distance,
    squared_distances as squared_distances,
)
from .uniformity import (
    adjusted_p_values as adjusted_p_values,
    ecdf_band as ecdf_band,
    evaluation_points as evaluation_points,
    uniformity_p_value as uniformity_p_value,
)

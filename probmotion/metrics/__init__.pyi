from .accuracy import (
    acceleration_error as acceleration_error,
    acceleration_ratio as acceleration_ratio,
    aligned_by_root as aligned_by_root,
    aligned_by_similarity as aligned_by_similarity,
    joint_errors as joint_errors,
)
from .chains import chain_diagnostics as chain_diagnostics
from .distribution import (
    mean_error as mean_error,
    precision_recall as precision_recall,
    sliced_wasserstein as sliced_wasserstein,
    sliced_wasserstein_ratio as sliced_wasserstein_ratio,
    trace_ratio as trace_ratio,
)
from .filming import film_motions as film_motions
from .generation import (
    GenerationReference as GenerationReference,
    diversity as diversity,
    frechet_distance as frechet_distance,
)
from .intervals import best_and_tied as best_and_tied, t_interval as t_interval
from .keypoints import (
    fit_linear_map as fit_linear_map,
    image_extent as image_extent,
    percentage_of_correct_keypoints as percentage_of_correct_keypoints,
    velocity_error as velocity_error,
)
from .measures import measure as measure
from .motion_chamfer import motion_chamfer_distance as motion_chamfer_distance
from .run_statistics import DrawStatistics as DrawStatistics, draw_statistics as draw_statistics
from .stein import kernel_stein_discrepancy as kernel_stein_discrepancy, score_of as score_of
from .two_sample import (
    classifier_two_sample as classifier_two_sample,
    discrepancy_p_value as discrepancy_p_value,
    maximum_mean_discrepancy as maximum_mean_discrepancy,
)
from .uniformity import (
    credible_level as credible_level,
    ecdf_band as ecdf_band,
    uniformity_p_value as uniformity_p_value,
)
from .verdict import Verdict as Verdict, judge as judge

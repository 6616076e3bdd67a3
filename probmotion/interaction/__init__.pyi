from .annotated_pairs import AnnotatedPairs as AnnotatedPairs
from .completion import (
    CompletionResult as CompletionResult,
    complete as complete,
    complete_keypoints as complete_keypoints,
    nearest_annotation_completion as nearest_annotation_completion,
    occluded_joint_error as occluded_joint_error,
)
from .regression import (
    RidgeCompletion as RidgeCompletion,
    ridge_completion as ridge_completion,
)
from .retrieval import (
    RetrievalResult as RetrievalResult,
    retrieve as retrieve,
    view_grid as view_grid,
    views_around as views_around,
)

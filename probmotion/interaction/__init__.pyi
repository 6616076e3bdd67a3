from .annotated_pairs import AnnotatedPairs as AnnotatedPairs
from .completion import (
    BANDWIDTH as BANDWIDTH,
)
from .completion import (
    Completed as Completed,
)
from .completion import (
    blend as blend,
)
from .completion import (
    complete as complete,
)
from .completion import (
    complete_keypoints as complete_keypoints,
)
from .completion import (
    hidden_joint_error as hidden_joint_error,
)
from .completion import (
    nearest_annotation_completion as nearest_annotation_completion,
)
from .retrieval import (
    Retrieved as Retrieved,
)
from .retrieval import (
    retrieve as retrieve,
)
from .retrieval import (
    view_grid as view_grid,
)
from .retrieval import (
    views_around as views_around,
)

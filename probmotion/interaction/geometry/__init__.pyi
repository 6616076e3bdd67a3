from .coordinates import (
    align_motions as align_motions,
    align_rigidly as align_rigidly,
    cartesian_distance as cartesian_distance,
    dissimilarity as dissimilarity,
    interaction_coordinates as interaction_coordinates,
    interaction_distance as interaction_distance,
)
from .delaunay import delaunay_edges as delaunay_edges
from .graphs import GRAPHS as GRAPHS, graph_edges as graph_edges, is_degenerate as is_degenerate
from .nearest import PairComparer as PairComparer
from .pose_distances import MEASURES as MEASURES
from .shape_context import (
    shape_context_distance as shape_context_distance,
    shape_contexts as shape_contexts,
)

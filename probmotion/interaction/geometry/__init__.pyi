from .coordinates import (
    align_motions as align_motions,
)
from .coordinates import (
    align_rigidly as align_rigidly,
)
from .coordinates import (
    cartesian_distance as cartesian_distance,
)
from .coordinates import (
    dissimilarity as dissimilarity,
)
from .coordinates import (
    interaction_coordinates as interaction_coordinates,
)
from .coordinates import (
    interaction_distance as interaction_distance,
)
from .delaunay import (
    delaunay_edges as delaunay_edges,
)
from .delaunay import (
    delaunay_into as delaunay_into,
)
from .delaunay import (
    most_edges as most_edges,
)
from .graph_kernels import (
    count_degenerate as count_degenerate,
)
from .graph_kernels import (
    edge_room as edge_room,
)
from .graph_kernels import (
    graph_into as graph_into,
)
from .graph_kernels import (
    graphs_of_visible as graphs_of_visible,
)
from .graphs import (
    GRAPHS as GRAPHS,
)
from .graphs import (
    JOGGLE as JOGGLE,
)
from .graphs import (
    N_NEIGHBOURS as N_NEIGHBOURS,
)
from .graphs import (
    check_graph as check_graph,
)
from .graphs import (
    graph_edges as graph_edges,
)
from .graphs import (
    is_degenerate as is_degenerate,
)
from .graphs import (
    joggle_offsets as joggle_offsets,
)
from .nearest import MEASURES as MEASURES
from .nearest import PairComparer as PairComparer
from .nearest_kernels import (
    CARTESIAN as CARTESIAN,
)
from .nearest_kernels import (
    INTERACTION as INTERACTION,
)
from .nearest_kernels import (
    SHAPE_CONTEXT as SHAPE_CONTEXT,
)
from .nearest_kernels import (
    Prepared as Prepared,
)
from .nearest_kernels import (
    all_distances as all_distances,
)
from .nearest_kernels import (
    centred as centred,
)
from .nearest_kernels import (
    distance_by_its_graph as distance_by_its_graph,
)
from .nearest_kernels import (
    distances_to as distances_to,
)
from .nearest_kernels import (
    look as look,
)
from .nearest_kernels import (
    nearest_in_batch as nearest_in_batch,
)
from .nearest_kernels import (
    nearest_in_batch_on_threads as nearest_in_batch_on_threads,
)
from .nearest_kernels import (
    nearest_of as nearest_of,
)
from .plane_contexts import context_cost as context_cost
from .plane_contexts import polar_bins as polar_bins
from .pose_distance_kernels import (
    cartesian_minima as cartesian_minima,
)
from .pose_distance_kernels import (
    cartesian_table as cartesian_table,
)
from .pose_distance_kernels import (
    interaction_minima as interaction_minima,
)
from .pose_distance_kernels import (
    interaction_table as interaction_table,
)
from .pose_distances import SHORTEST_EDGE as SHORTEST_EDGE
from .pose_distances import Measure as Measure
from .rigid_kernels import align as align
from .rigid_kernels import residual as residual
from .shape_context import (
    N_ANGLES as N_ANGLES,
)
from .shape_context import (
    RING_EDGES as RING_EDGES,
)
from .shape_context import (
    shape_context_distance as shape_context_distance,
)
from .shape_context import (
    shape_context_distances as shape_context_distances,
)
from .shape_context import (
    shape_contexts as shape_contexts,
)
from .shape_distance_kernels import (
    N_RINGS as N_RINGS,
)
from .shape_distance_kernels import (
    ring_counts as ring_counts,
)
from .shape_distance_kernels import (
    shape_minima as shape_minima,
)
from .shape_distance_kernels import (
    shape_table as shape_table,
)

from .coordinates import (
    align_motions as align_motions,
    align_rigidly as align_rigidly,
    cartesian_distance as cartesian_distance,
    dissimilarity as dissimilarity,
    interaction_coordinates as interaction_coordinates,
    interaction_distance as interaction_distance,
)
from .delaunay import (
    delaunay_edges as delaunay_edges,
    delaunay_into as delaunay_into,
    most_edges as most_edges,
)
from .graph_kernels import (
    count_degenerate as count_degenerate,
    edge_room as edge_room,
    graph_into as graph_into,
    graphs_of_visible as graphs_of_visible,
)
from .graphs import (
    GRAPHS as GRAPHS,
    JOGGLE as JOGGLE,
    N_NEIGHBOURS as N_NEIGHBOURS,
    check_graph as check_graph,
    graph_edges as graph_edges,
    is_degenerate as is_degenerate,
    joggle_offsets as joggle_offsets,
)
from .nearest import MEASURES as MEASURES, PairComparer as PairComparer
from .nearest_kernels import (
    CARTESIAN as CARTESIAN,
    INTERACTION as INTERACTION,
    SHAPE_CONTEXT as SHAPE_CONTEXT,
    Prepared as Prepared,
    all_distances as all_distances,
    centred as centred,
    distance_by_its_graph as distance_by_its_graph,
    distances_to as distances_to,
    look as look,
    nearest_in_batch as nearest_in_batch,
    nearest_in_batch_on_threads as nearest_in_batch_on_threads,
    nearest_of as nearest_of,
)
from .plane_contexts import context_cost as context_cost, polar_bins as polar_bins
from .pose_distance_kernels import (
    cartesian_minima as cartesian_minima,
    cartesian_table as cartesian_table,
    interaction_minima as interaction_minima,
    interaction_table as interaction_table,
)
from .pose_distances import SHORTEST_EDGE as SHORTEST_EDGE, Measure as Measure
from .rigid_kernels import align as align, residual as residual
from .shape_context import (
    N_ANGLES as N_ANGLES,
    RING_EDGES as RING_EDGES,
    shape_context_distance as shape_context_distance,
    shape_context_distances as shape_context_distances,
    shape_contexts as shape_contexts,
)
from .shape_distance_kernels import (
    N_RINGS as N_RINGS,
    ring_counts as ring_counts,
    shape_minima as shape_minima,
    shape_table as shape_table,
)

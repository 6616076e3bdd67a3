from .animation import (
    Playing as Playing,
    play_skeletons as play_skeletons,
    playing_figure as playing_figure,
)
from .calibration_curves import draw_calibration as draw_calibration
from .colours import (
    CYCLE as CYCLE,
    GREY as GREY,
    INK as INK,
    LEFT as LEFT,
    RIGHT as RIGHT,
    save_figure as save_figure,
    style_of as style_of,
)
from .coverage import (
    classical_scaling as classical_scaling,
    draw_coverage as draw_coverage,
    draw_embedding as draw_embedding,
)
from .error_plots import draw_error_decomposition as draw_error_decomposition
from .generation import draw_generation as draw_generation
from .label_placement import Box as Box, place_labels as place_labels
from .pairs import draw_pairs as draw_pairs
from .quality import plot_quality_against_cost as plot_quality_against_cost
from .ranks import draw_ranks as draw_ranks
from .skeletons import draw_skeletons as draw_skeletons

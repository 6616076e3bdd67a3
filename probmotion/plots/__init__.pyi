from .animation import (
    Playing as Playing,
)
from .animation import (
    play_skeletons as play_skeletons,
)
from .animation import (
    playing_figure as playing_figure,
)
from .calibration_curves import draw_calibration as draw_calibration
from .colours import (
    CYCLE as CYCLE,
)
from .colours import (
    GREY as GREY,
)
from .colours import (
    INK as INK,
)
from .colours import (
    LEFT as LEFT,
)
from .colours import (
    RIGHT as RIGHT,
)
from .colours import (
    save_figure as save_figure,
)
from .colours import (
    style_of as style_of,
)
from .coverage import (
    classical_scaling as classical_scaling,
)
from .coverage import (
    draw_coverage as draw_coverage,
)
from .coverage import (
    draw_embedding as draw_embedding,
)
from .error_plots import draw_budget as draw_budget
from .generation import draw_generation as draw_generation
from .label_placement import Box as Box
from .label_placement import place_labels as place_labels
from .pairs import draw_pairs as draw_pairs
from .quality import plot_quality_against_cost as plot_quality_against_cost
from .ranks import draw_ranks as draw_ranks
from .skeletons import draw_skeletons as draw_skeletons

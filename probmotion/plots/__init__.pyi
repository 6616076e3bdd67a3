from .animation import Animation as Animation, animate_skeletons as animate_skeletons
from .calibration_curves import draw_calibration as draw_calibration
from .coverage import (
    classical_scaling as classical_scaling,
    draw_coverage as draw_coverage,
    draw_embedding as draw_embedding,
)
from .error_plots import draw_error_decomposition as draw_error_decomposition
from .generation import draw_generation as draw_generation
from .pairs import draw_pairs as draw_pairs
from .quality import plot_quality_against_cost as plot_quality_against_cost
from .ranks import draw_ranks as draw_ranks
from .skeletons import draw_skeletons as draw_skeletons
from .spread import joint_sd as joint_sd, plot_spread as plot_spread
from .style import SamplerStyle as SamplerStyle, sampler_style as sampler_style

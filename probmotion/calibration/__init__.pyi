from .error_decomposition import decompose_error as decompose_error
from .error_result import ErrorDecomposition as ErrorDecomposition
from .grid import FEWEST_SIMULATIONS as FEWEST_SIMULATIONS, calibrate as calibrate
from .negative_control import Overconfident as Overconfident
from .result import Calibration as Calibration

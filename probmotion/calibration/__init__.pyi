from .error_decomposition import bias_budget as bias_budget
from .error_result import BiasBudget as BiasBudget
from .grid import FEWEST_SIMULATIONS as FEWEST_SIMULATIONS
from .grid import calibrate as calibrate
from .negative_control import Overconfident as Overconfident
from .result import Calibration as Calibration

from .budgets import (
    Budget as Budget,
)
from .budgets import (
    affordable as affordable,
)
from .budgets import (
    check_budget as check_budget,
)
from .budgets import (
    effort_of as effort_of,
)
from .cell_results import (
    DRAWS as DRAWS,
)
from .cell_results import (
    RESULT as RESULT,
)
from .cell_results import (
    CellResult as CellResult,
)
from .cell_results import (
    read_draws as read_draws,
)
from .cell_results import (
    read_result as read_result,
)
from .cell_results import (
    used_of_budget as used_of_budget,
)
from .failures import (
    CellNotKept as CellNotKept,
)
from .failures import (
    Failure as Failure,
)
from .failures import (
    NotFinite as NotFinite,
)
from .failures import (
    TimeIsUp as TimeIsUp,
)
from .failures import (
    WorkerDied as WorkerDied,
)
from .grid_results import GridResults as GridResults
from .naming import (
    AnyProblem as AnyProblem,
)
from .naming import (
    AnySampler as AnySampler,
)
from .naming import (
    named_problems as named_problems,
)
from .naming import (
    named_samplers as named_samplers,
)
from .plan import Plan as Plan
from .qualities import QUALITIES as QUALITIES
from .qualities import best_of as best_of
from .qualities import first_quality as first_quality
from .script_code import (
    SIMPLE as SIMPLE,
)
from .script_code import (
    class_content as class_content,
)
from .script_code import (
    is_of_a_script as is_of_a_script,
)
from .script_code import (
    reached as reached,
)
from .stored_problems import (
    KeptProblem as KeptProblem,
)
from .stored_problems import (
    keep_problem as keep_problem,
)
from .stored_problems import (
    read_kept as read_kept,
)
from .table import ComparisonTable as ComparisonTable

from .budgets import (
    Budget as Budget,
    affordable as affordable,
    check_budget as check_budget,
    effort_of as effort_of,
)
from .cell_results import (
    DRAWS as DRAWS,
    RESULT as RESULT,
    CellResult as CellResult,
    read_draws as read_draws,
    read_result as read_result,
    used_of_budget as used_of_budget,
)
from .failures import (
    CellNotKept as CellNotKept,
    Failure as Failure,
    NotFinite as NotFinite,
    TimeIsUp as TimeIsUp,
    WorkerDied as WorkerDied,
)
from .grid_results import GridResults as GridResults
from .naming import (
    AnyProblem as AnyProblem,
    AnySampler as AnySampler,
    named_problems as named_problems,
    named_samplers as named_samplers,
)
from .plan import Plan as Plan
from .qualities import QUALITIES as QUALITIES, best_of as best_of, first_quality as first_quality
from .script_code import (
    SIMPLE as SIMPLE,
    class_content as class_content,
    is_of_a_script as is_of_a_script,
    reached as reached,
)
from .stored_problems import (
    StoredProblem as StoredProblem,
    read_stored as read_stored,
    store_problem as store_problem,
)
from .table import ComparisonTable as ComparisonTable

from .budgets import Budget as Budget
from .failures import Failure as Failure
from .grid_results import GridResults as GridResults
from .headline_metrics import (
    HEADLINE_METRICS as HEADLINE_METRICS,
    best_of as best_of,
    headline_metric as headline_metric,
)
from .plan import Plan as Plan
from .run_results import RunResult as RunResult
from .stored_problems import StoredProblem as StoredProblem
from .table import ComparisonTable as ComparisonTable

from .advice import Advice as Advice, Standing as Standing, advise as advise
from .grid import Comparison as Comparison, compare as compare
from .measurements import (
    Measured as Measured,
    measured as measured,
    save_measurements as save_measurements,
)
from .quick import (
    QUICK as QUICK,
    QUICK_BUDGET as QUICK_BUDGET,
    QUICK_DRAWS as QUICK_DRAWS,
    QUICK_LIMIT as QUICK_LIMIT,
    quick_samplers as quick_samplers,
)
from .results.budgets import Budget as Budget

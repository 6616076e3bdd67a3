from .advice import Advice as Advice
from .advice import Standing as Standing
from .advice import advise as advise
from .comparison import Comparison as Comparison
from .grid import compare as compare
from .measurements import Measured as Measured
from .measurements import keep_measured as keep_measured
from .measurements import measured as measured
from .quick import (
    QUICK as QUICK,
)
from .quick import (
    QUICK_BUDGET as QUICK_BUDGET,
)
from .quick import (
    QUICK_DRAWS as QUICK_DRAWS,
)
from .quick import (
    QUICK_LIMIT as QUICK_LIMIT,
)
from .quick import (
    quick_samplers as quick_samplers,
)
from .results.budgets import Budget as Budget

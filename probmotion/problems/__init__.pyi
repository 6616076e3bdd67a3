from .catalogue import (
    load_problem as load_problem,
)
from .catalogue import (
    problem_descriptions as problem_descriptions,
)
from .catalogue import (
    problem_names as problem_names,
)
from .catalogue import (
    problem_without_reference as problem_without_reference,
)
from .catalogue import (
    problems_at_hand as problems_at_hand,
)
from .clips import clips_problem as clips_problem
from .pairs import pairs_problem as pairs_problem

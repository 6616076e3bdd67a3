from .catalogue import (
    load_problem as load_problem,
    problem_descriptions as problem_descriptions,
    problem_names as problem_names,
    problem_without_reference as problem_without_reference,
    problems_at_hand as problems_at_hand,
)
from .clips import clips_problem as clips_problem
from .pairs import pairs_problem as pairs_problem

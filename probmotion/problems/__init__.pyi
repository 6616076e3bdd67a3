from .catalogue import (
    available_problems as available_problems,
    load_problem as load_problem,
    problem_descriptions as problem_descriptions,
    problem_names as problem_names,
    problem_without_reference as problem_without_reference,
)
from .clips import clips_problem as clips_problem
from .pairs import pairs_problem as pairs_problem

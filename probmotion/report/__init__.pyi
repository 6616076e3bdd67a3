from .animations import BUDGET as BUDGET, players as players, shown_problems as shown_problems
from .header import (
    contents as contents,
    facts as facts,
    note_ids as note_ids,
    notes as notes,
    reading as reading,
)
from .motions import Shown as Shown, choose_draws as choose_draws, motion_numbers as motion_numbers
from .page import write_report as write_report
from .plots import marker as marker, quality_against_cost as quality_against_cost
from .tables import Outcome as Outcome, problem_tables as problem_tables, value_cell as value_cell

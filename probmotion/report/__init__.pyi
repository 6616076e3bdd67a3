from .animations import BUDGET as BUDGET
from .animations import players as players
from .animations import shown_problems as shown_problems
from .header import (
    contents as contents,
)
from .header import (
    facts as facts,
)
from .header import (
    note_ids as note_ids,
)
from .header import (
    notes as notes,
)
from .header import (
    reading as reading,
)
from .motions import Shown as Shown
from .motions import choose_draws as choose_draws
from .motions import motion_numbers as motion_numbers
from .page import write_report as write_report
from .plots import marker as marker
from .plots import quality_against_cost as quality_against_cost
from .tables import Outcome as Outcome
from .tables import problem_tables as problem_tables
from .tables import value_cell as value_cell

from .grid_runs import GridRun as GridRun
from .grid_tasks import GridTask as GridTask, Pilot as Pilot, PilotResult as PilotResult
from .locks import locked as locked
from .memory import watched_memory as watched_memory
from .tasks import (
    Grid as Grid,
    refuse_other_settings as refuse_other_settings,
    run_grid as run_grid,
)
from .time_limits import time_limit as time_limit

from .cells import Cell as Cell, forget_unfinished as forget_unfinished
from .locks import locked as locked
from .memory import PeakMemory as PeakMemory, watched_memory as watched_memory
from .pilots import Found as Found, Pilot as Pilot
from .processes import Done as Done, Task as Task, run_in_processes as run_in_processes
from .tasks import Grid as Grid, refuse_taken as refuse_taken, run_grid as run_grid
from .time_limits import time_limit as time_limit
from .workers import run_task as run_task, run_tasks as run_tasks

from .result import Lift as Lift
from .track_lift import lift as lift

from .recording_lift import lift as lift
from .result import Lift as Lift

from .pairs import LiftedPairs as LiftedPairs, lift_pairs as lift_pairs
from .recording_lift import lift as lift
from .result import Lift as Lift

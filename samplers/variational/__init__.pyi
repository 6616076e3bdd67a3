from .amortised import (
    AmortisedPosterior as AmortisedPosterior,
)
from .amortised import (
    AmortisedSettings as AmortisedSettings,
)
from .amortised_network import ConditionalVAE as ConditionalVAE
from .dvae import DVAEInference as DVAEInference
from .simulated_pairs import (
    MotionCoordinates as MotionCoordinates,
)
from .simulated_pairs import (
    PrincipalCoordinates as PrincipalCoordinates,
)
from .simulated_pairs import (
    SimulatedPairs as SimulatedPairs,
)
from .simulated_pairs import (
    observed_entries as observed_entries,
)
from .simulated_pairs import (
    simulate_pairs as simulate_pairs,
)

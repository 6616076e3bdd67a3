from .amortised import (
    AmortisedPosterior as AmortisedPosterior,
    AmortisedSettings as AmortisedSettings,
)
from .amortised_network import ConditionalVAE as ConditionalVAE
from .dvae import DVAEInference as DVAEInference
from .simulated_pairs import (
    MotionCoordinates as MotionCoordinates,
    PrincipalCoordinates as PrincipalCoordinates,
    SimulatedPairs as SimulatedPairs,
    observed_entries as observed_entries,
    simulate_pairs as simulate_pairs,
)

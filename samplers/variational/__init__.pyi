from .dvae import DVAEInference as DVAEInference

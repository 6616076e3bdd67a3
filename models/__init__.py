"""Priors over motion and networks for their evaluation. No model imports a sampler."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

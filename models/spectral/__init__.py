"""Spectral mixture prior over motions of any length, with exact density and posterior."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

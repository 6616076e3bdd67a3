"""Gaussian mixtures over motions: exact density, denoisers, posterior and denoising."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

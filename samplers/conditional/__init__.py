"""Samplers of posteriors that use a denoiser without guiding each of its estimates."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

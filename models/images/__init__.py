"""Posterior over pose, shape and motion given images, and the renderers of its likelihood."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

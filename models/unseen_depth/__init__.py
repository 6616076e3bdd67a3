"""Depths that keypoints do not show: priors learnt from 2D alone, and a regression."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Gaussian priors over 3D poses and motions learnt from 2D alone, with exact lifting."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

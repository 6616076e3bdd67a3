"""Sizes of the motion VAE, by name, and the weights of what it is trained on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.validation import check_count

__all__ = ["USUAL_THRESHOLD", "MotionVAESettings"]

USUAL_THRESHOLD = 0.3
"""Least confidence of a joint that is learnt from, and that networks are shown."""

_WEIGHTS = ("reconstruction", "smoothness", "ranges", "lengths", "kl", "teacher")


@dataclass(frozen=True)
class MotionVAESettings:
    """Size of the motion VAE and of its pose network, and the weights of their losses.

    Parameters
    ----------
    frames : int
        T, frames of a motion.
    width : int
        Numbers of a token in every transformer.
    layers : int
        Of each of E_s, E_t, D_t and D_s.
    heads : int
        Of each layer.
    feedforward : int
        Width of each layer's hidden layer. It is not published; ours is a quarter of the tokens'
        because a training step of 64 sequences should take half a second on two cores. At size
        ``small`` a quarter reconstructs as well as the tokens' width and generates 3 % farther from
        held-out clips (Motion Chamfer Distance, two seeds).
    latent : int
        Numbers of z.
    spatial : bool
        Whether there are E_s and D_s; without them, linear maps of all joints and of all bones at
        once take their place (table 7).
    hypotheses : int
        H, views that the pose network supposes, 1 to 4: a quarter turn apart.
    image_features : int
        F, numbers of an image feature of a frame and of a joint; 0: tracks alone.
    mixed_precision : bool
        Whether a network in training multiplies matrices in bfloat16. Weights, sums of layers,
        results and losses stay in single precision, and so does all of a network that is used.
        Worth it on processors with bfloat16 products (AVX-512 BF16, AMX), where it is several times
        as fast.
    reconstruction : float
        Weight of the squared distance of reprojected joints to seen ones, metres squared.
    smoothness : float
        Of squared differences of neighbouring frames, λ of R_temp.
    ranges : float
        Of squared angles beyond the joints' ranges.
    lengths : float
        Of squared logarithms of bone lengths over the rest pose's.
    kl : float
        λ_KL, of the divergence of q(z) from N(0, I).
    teacher : float
        Of the squared distance to the pose network's poses.

    Raises
    ------
    ValueError
        If a number is out of range, or ``width`` is no even multiple of ``heads``.
    """

    frames: int = 10
    width: int = 256
    layers: int = 4
    heads: int = 4
    feedforward: int = 64
    latent: int = 256
    spatial: bool = True
    hypotheses: int = 4
    image_features: int = 0
    mixed_precision: bool = True
    reconstruction: float = 1.0
    smoothness: float = 1.0
    ranges: float = 0.1
    lengths: float = 0.1
    kl: float = 0.001
    teacher: float = 1.0

    def __post_init__(self) -> None:
        check_count("frames", self.frames, least=2)
        for name in ("width", "layers", "heads", "feedforward", "latent", "hypotheses"):
            check_count(name, getattr(self, name))
        check_count("image_features", self.image_features, least=0)
        if self.width % self.heads or self.width % 2:
            raise ValueError(
                f"width must be an even multiple of heads, {self.heads}, got {self.width}"
            )
        if self.hypotheses > 4:
            raise ValueError(
                f"hypotheses is {self.hypotheses}, expected 1 to 4: they are a quarter turn apart"
            )
        for name in ("spatial", "mixed_precision"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        for name in _WEIGHTS:
            _check_weight(name, getattr(self, name))

    @classmethod
    def tiny(cls) -> MotionVAESettings:
        """Return the size for tests: learns a toy in seconds."""
        return cls(
            width=32,
            layers=1,
            heads=2,
            feedforward=64,
            latent=8,
            mixed_precision=False,
            smoothness=0.01,
            teacher=0.1,
        )

    @classmethod
    def small(cls) -> MotionVAESettings:
        """Return the size that two cores train in minutes, and that ships.

        Smoothness and teacher weigh .01 and .1, not the published 1: reconstruction is in squared
        metres here, some hundredths, beside which a weight of 1 left bodies still.
        """
        return cls(
            width=96,
            layers=2,
            heads=2,
            feedforward=96,
            latent=48,
            smoothness=0.01,
            teacher=0.1,
        )

    @classmethod
    def paper(cls) -> MotionVAESettings:
        """Return the published size and weights (section 3.3, table 5).

        The published reconstruction is that of images; ours is of joints, in metres.
        """
        return cls()


def _check_weight(name: str, value: float) -> None:
    """Raise ``ValueError`` unless a loss's weight is a finite number of at least 0."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not (number and np.isfinite(value) and value >= 0):
        raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")

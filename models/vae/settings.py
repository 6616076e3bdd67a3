"""Network sizes and loss weights of the motion VAE."""

from __future__ import annotations

from dataclasses import dataclass, replace

from probmotion.validation import check_count, check_not_negative

__all__ = ["CONFIDENCE_THRESHOLD", "MotionVAESettings"]

CONFIDENCE_THRESHOLD = 0.3
"""Minimum confidence of visible joints in training and inference."""

_WEIGHTS = ("reconstruction", "smoothness", "ranges", "lengths", "kl", "teacher")  # loss weights


@dataclass(frozen=True)
class MotionVAESettings:
    """Network size and loss weights of the motion VAE and its pose network.

    Parameters
    ----------
    frames : int
        Number of frames T per motion.
    width : int
        Token width of all transformers.
    layers, heads : int
        Number of layers of each encoder (E_s, E_t) and decoder (D_t, D_s), and heads per layer.
    feedforward : int
        Hidden width of the perceptron of each layer; not published. At size ``small``,
        reconstruction is equally accurate with a quarter of ``width``.
    latent : int
        Dimension of the latent code z.
    spatial : bool
        Whether to use E_s and D_s; otherwise linear maps of joints and bones (Ponymation, table 7).
    hypotheses : int
        Number of view hypotheses H of the pose network, 1 to 4, at quarter turns.
    image_features : int
        Size F of image features per frame and per joint; 0 for tracks without images.
    mixed_precision : bool
        Whether to multiply in bfloat16 during training; weights, sums, outputs and losses stay in
        single precision. Several times faster on processors with AVX-512 BF16 or AMX.
    reconstruction : float
        Weight of the squared reprojection error, which is in m².
    smoothness : float
        Weight λ of the temporal regulariser R_temp.
    ranges : float
        Weight of squared angles beyond the joint ranges.
    lengths : float
        Weight of squared log ratios of bone lengths to the rest pose.
    kl : float
        Weight λ_KL of the divergence KL(q(z) ‖ N(0, I)).
    teacher : float
        Weight of the squared difference from the pose network's bone rotations.

    Raises
    ------
    ValueError
        If a parameter is out of range, or ``width`` is odd or not a multiple of ``heads``.
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
                f"width must be even and a multiple of heads={self.heads}, got {self.width}"
            )
        if self.hypotheses > 4:
            raise ValueError(
                f"hypotheses must be 1 to 4, one per quarter turn, got {self.hypotheses}"
            )
        for name in ("spatial", "mixed_precision"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        for name in _WEIGHTS:
            check_not_negative(name, getattr(self, name))

    @classmethod
    def tiny(cls) -> MotionVAESettings:
        """Return settings for tests, with networks that train in seconds."""
        size = cls(width=32, layers=1, heads=2, latent=8, mixed_precision=False)
        return replace(size, smoothness=0.01, teacher=0.1)

    @classmethod
    def small(cls) -> MotionVAESettings:
        """Return the settings of the shipped priors, which train in minutes on two cores.

        Smoothness and teacher weights are .01 and .1: the published 1 would suppress all motion,
        because the reconstruction loss of joints is only a few hundredths of a m².
        """
        size = cls(width=96, layers=2, heads=2, feedforward=96, latent=48)
        return replace(size, smoothness=0.01, teacher=0.1)

    @classmethod
    def paper(cls) -> MotionVAESettings:
        """Return the published size and weights (Ponymation, section 3.3, table 5).

        The published reconstruction loss compares images; the loss here compares joints, in m².
        """
        return cls()

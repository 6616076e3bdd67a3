"""Network sizes of the Motion-DVAE."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from probmotion.validation import check_count

__all__ = ["DVAESettings"]

Decoder = Literal["cumulative", "direct"]
DecoderScale = Literal["learned", "unit"]


@dataclass(frozen=True)
class DVAESettings:
    """Network size and decoder of a Motion-DVAE.

    Parameters
    ----------
    frames : int
        Number of frames per training window.
    latent : int
        Dimension of z_t.
    hidden : int
        Width of the recurrent states and hidden layers.
    groups : int
        Number of groups in group normalisation.
    decoder : {"cumulative", "direct"}
        Mean of a state: ``direct`` (published) d_x(h_t); ``cumulative`` the previous mean,
        initially x₀, plus d_x(h_t) and a linear map of z_t. The cumulative decoder requires much
        less training data and is combined with a ``TrackingEncoder``.
    decoder_scale : {"learned", "unit"}
        Standard deviation s_x of the decoder: learned per part of the state, or 1 (published).

    Raises
    ------
    ValueError
        If a number is out of range or ``hidden`` is not a multiple of ``groups``.
    """

    frames: int = 30
    latent: int = 48
    hidden: int = 1024
    groups: int = 16
    decoder: Decoder = "direct"
    decoder_scale: DecoderScale = "learned"

    def __post_init__(self) -> None:
        check_count("frames", self.frames, least=2)
        for name in ("latent", "hidden", "groups"):
            check_count(name, getattr(self, name))
        if self.hidden % self.groups:
            raise ValueError(
                f"hidden must be a multiple of groups={self.groups}, got {self.hidden}"
            )
        for name, known in (("decoder", Decoder), ("decoder_scale", DecoderScale)):
            value, choices = getattr(self, name), get_args(known)
            if value not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")

    @classmethod
    def tiny(cls) -> DVAESettings:
        """Return a size for tests, which trains in seconds."""
        return cls(frames=12, latent=6, hidden=32, groups=4, decoder="cumulative")

    @classmethod
    def small(cls) -> DVAESettings:
        """Return the size of the shipped prior, which trains in minutes on two cores."""
        return cls(latent=24, hidden=160, decoder="cumulative")

    @classmethod
    def paper(cls) -> DVAESettings:
        """Return the published size and decoder (A.1, A.4)."""
        return cls()

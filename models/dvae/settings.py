"""Sizes of a Motion-DVAE, by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from probmotion.validation import check_count

__all__ = ["DVAESettings"]

Decoder = Literal["cumulative", "direct"]
DecoderScale = Literal["learned", "unit"]


@dataclass(frozen=True)
class DVAESettings:
    """Size of a Motion-DVAE, and what its decoder's error is measured in.

    Parameters
    ----------
    frames : int
        Frames of the windows that it learns.
    latent : int
        Numbers in z_t.
    hidden : int
        Width of recurrent states and of layers.
    groups : int
        Of the group normalisation.
    decoder : {"cumulative", "direct"}
        μ_x(z_{1:t}, x₀) is the last frame's plus d_x(h_t) and a linear map of z_t, or d_x(h_t)
        alone, as published. The first begins at x₀ exactly and says how frames differ; inference
        is then a ``TrackingEncoder``. It needs much less motion to learn from.
    decoder_scale : {"learned", "unit"}
        s_x: a standard deviation learnt for each part of a state, or 1 in the state's own units,
        as published.

    Raises
    ------
    ValueError
        If a number is out of range, or ``hidden`` is no multiple of ``groups``.
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
            if getattr(self, name) not in get_args(known):
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}, expected one of "
                    f"{', '.join(get_args(known))}"
                )

    @classmethod
    def tiny(cls) -> DVAESettings:
        """Return the size for tests: learns a toy in seconds."""
        return cls(frames=12, latent=6, hidden=32, groups=4, decoder="cumulative")

    @classmethod
    def small(cls) -> DVAESettings:
        """Return the size that two cores train in minutes, and that ships."""
        return cls(latent=24, hidden=160, decoder="cumulative")

    @classmethod
    def paper(cls) -> DVAESettings:
        """Return the published size and decoder (A.1, A.4)."""
        return cls()

"""Conditional VAE of motions given observations, in principal coordinates.

    p(x, z | y) = p(z | y) N(x; μ(z, y), S),   r(z | x, y) = N(z; a(x, y), b(x, y)²)

x and y are the coordinates of a motion and of its observations, and r is the encoder. p(z | y) is a
Gaussian mixture that can represent several modes; μ is a mixture of linear maps plus a neural
network. Training maximises E[log N(x; μ, S) − KL(r ‖ p)] (Sohn, Lee and Yan 2015).
"""

from __future__ import annotations

from probmotion.extras import nn, torch

__all__ = ["ConditionalVAE"]

# Bounds of log scales, for stability early in training.
_LOG_SCALE_BOUNDS = -7.0, 2.0


class ConditionalVAE(nn.Module):
    """Conditional VAE with a Gaussian-mixture prior.

    Parameters
    ----------
    coordinates, observed : int
        Dimensions C of x and E of y; E = 0 without observations.
    latent : int
        Dimension of z.
    components : int
        Number K of mixture components of p(z | y).
    experts : int
        Number of linear maps in μ.
    hidden : int
        Width of every network.
    """

    def __init__(
        self,
        coordinates: int,
        observed: int,
        latent: int,
        components: int,
        experts: int,
        hidden: int,
    ) -> None:
        super().__init__()
        self.latent = latent
        self.encoder = nn.Sequential(
            nn.Linear(coordinates + observed, hidden), nn.SiLU(),
            nn.Linear(hidden, hidden), nn.SiLU(),
            nn.Linear(hidden, 2 * latent),
        )  # fmt: skip
        self.prior = _MixtureOfGaussians(observed, latent, components, hidden)
        self.decoder = _MixtureOfLinearMaps(latent + observed, coordinates, experts, hidden)
        self.log_scale = nn.Parameter(torch.zeros(coordinates))

    def encode(self, x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a and log b of r(z | x, y), (B, latent) each, from x, (B, C), and y, (B, E)."""
        mean, log_scale = self.encoder(torch.cat([x, y], dim=1)).chunk(2, dim=1)
        return mean, log_scale.clamp(*_LOG_SCALE_BOUNDS)

    def decode(self, z: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Return μ(z, y): ``(B, latent), (B, E) → (B, C)``."""
        return self.decoder(torch.cat([z, y], dim=1))

    def loss(
        self, x: torch.Tensor, y: torch.Tensor, noise: torch.Tensor, weight: float
    ) -> torch.Tensor:
        """Return −E[log N(x; μ, S)] + ``weight`` · KL(r ‖ p) up to a constant, averaged over pairs.

        S is diagonal here; both terms are estimated from one sample z = a + b · ``noise``.
        """
        mean, log_scale = self.encode(x, y)
        z = mean + log_scale.exp() * noise
        log_r = (-0.5 * noise**2 - log_scale).sum(dim=1)
        residual = (x - self.decode(z, y)) * torch.exp(-self.log_scale)
        misfit = 0.5 * (residual**2).sum(dim=1) + self.log_scale.sum()
        return (misfit + weight * (log_r - self.prior.log_density(z, y))).mean()

    @torch.no_grad()
    def misfits(self, x: torch.Tensor, y: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Return x − μ(z, y) with z = a + b · ``noise`` from r(z | x, y), (B, C)."""
        mean, log_scale = self.encode(x, y)
        return x - self.decode(mean + log_scale.exp() * noise, y)


class _MixtureOfGaussians(nn.Module):
    """Gaussian mixture p(z | y) = Σ_k π_k(y) N(m_k + m(y), (s_k s(y))²)."""

    def __init__(self, observed: int, latent: int, components: int, hidden: int) -> None:
        super().__init__()
        self.sizes = [components, latent, latent]
        self.log_weight = nn.Parameter(torch.zeros(components))
        self.mean = nn.Parameter(torch.randn(components, latent))
        self.log_scale = nn.Parameter(torch.full((components, latent), -0.5))
        self.network = None
        if observed:
            self.network = nn.Sequential(
                nn.Linear(observed, hidden), nn.SiLU(),
                nn.Linear(hidden, hidden), nn.SiLU(),
                nn.Linear(hidden, sum(self.sizes)),
            )  # fmt: skip

    def forward(self, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return log π, (B, K), and means and log scales, (B, K, latent) each."""
        log_weight, mean, log_scale = (
            part.expand(len(y), *part.shape)
            for part in (self.log_weight, self.mean, self.log_scale)
        )
        if self.network is not None:
            weight_shift, mean_shift, scale_shift = self.network(y).split(self.sizes, dim=1)
            log_weight = log_weight + weight_shift
            mean, log_scale = mean + mean_shift[:, None], log_scale + scale_shift[:, None]
        return torch.log_softmax(log_weight, dim=1), mean, log_scale.clamp(*_LOG_SCALE_BOUNDS)

    def log_density(self, z: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Return log p(z | y) up to a constant: ``(B, latent), (B, E) → (B,)``."""
        log_weight, mean, log_scale = self(y)
        standardised = (z[:, None] - mean) * torch.exp(-log_scale)
        log_terms = log_weight - (0.5 * standardised**2 + log_scale).sum(dim=2)
        return torch.logsumexp(log_terms, dim=1)


class _MixtureOfLinearMaps(nn.Module):
    """Mixture of linear maps, f(v) = Σ_e g_e(v) (A_e v + b_e) + h(v); g and h share a network."""

    def __init__(self, inputs: int, outputs: int, experts: int, hidden: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU()
        )
        self.gate = nn.Linear(hidden, experts)
        self.bounded = nn.Linear(hidden, outputs)
        self.maps = nn.Parameter(0.02 * torch.randn(experts * (inputs + 1), outputs))

    def forward(self, v: torch.Tensor) -> torch.Tensor:
        """Return f(v): ``(B, inputs) → (B, outputs)``."""
        features = self.trunk(v)
        gate = torch.softmax(self.gate(features), dim=1)
        with_one = torch.cat([v, torch.ones_like(v[:, :1])], dim=1)
        mixed = (gate[:, :, None] * with_one[:, None, :]).flatten(1) @ self.maps
        return mixed + self.bounded(features)

"""References to cite for draws: the method, the sampling library and probmotion."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["CITATIONS", "OF_SETTINGS", "POSE_PAIRS", "citations_of"]

_OURS = "The probmotion authors. probmotion: one posterior over 3D skeletal motion, many samplers."
_DDPM = "Ho, Jain, Abbeel (2020). Denoising diffusion probabilistic models. NeurIPS."
_COSINE = "Nichol, Dhariwal (2021). Improved denoising diffusion probabilistic models. ICML."
_KARRAS = (
    "Karras, Aittala, Aila, Laine (2022). Elucidating the design space of diffusion-based "
    "generative models. NeurIPS."
)
_SOLVER = (
    "Lu, Zhou, Bao, Chen, Li, Zhu (2022). DPM-Solver++: fast solver for guided sampling of "
    "diffusion probabilistic models. arXiv:2211.01095."
)
_TWISTED = (
    "Wu, Trippe, Naesseth, Blei, Cunningham (2023). Practical and asymptotically exact "
    "conditional sampling in diffusion models. NeurIPS."
)
_HMC = "Neal (2011). MCMC using Hamiltonian dynamics. Handbook of Markov Chain Monte Carlo."
_MAS = (
    "Kapon, Tevet, Cohen-Or, Bermano (2024). MAS: multi-view ancestral sampling for 3D motion "
    "generation using 2D diffusion. CVPR."
)

CITATIONS: Mapping[str, tuple[str, ...]] = {
    "exact": (
        "Tipping, Bishop (1999). Mixtures of probabilistic principal component analysers. Neural "
        "Computation 11.",
    ),
    "ancestral3d": (_DDPM, _SOLVER, _KARRAS),
    "mas": (_MAS, _DDPM, _COSINE),
    "mvpc": (
        _MAS,
        "Song et al. (2021). Score-based generative modeling through stochastic differential "
        "equations. ICLR.",
        _SOLVER,
        _KARRAS,
    ),
    "split-gibbs": (
        "Vono, Dobigeon, Chainais (2019). Split-and-augmented Gibbs sampler: application to "
        "large-scale inference problems. IEEE Trans. Signal Processing 67.",
        "Wu, Sun, Chen, Zhang, Yue, Bouman (2024). Principled probabilistic imaging using "
        "diffusion models as plug-and-play priors. NeurIPS.",
        _TWISTED,
        _SOLVER,
        _KARRAS,
    ),
    "daps": (
        "Zhang, Chu, Berner, Meng, Anandkumar, Song (2025). Improving diffusion inverse problem "
        "solving with decoupled noise annealing. CVPR.",
    ),
    "red-diff": (
        "Mardani, Song, Kautz, Vahdat (2024). A variational perspective on solving inverse "
        "problems with diffusion models. ICLR.",
    ),
    "tds": (_TWISTED,),
    "sync-tweedies": (
        "Kim, Koo, Yeo, Sung (2024). SyncTweedies: a general generative framework based on "
        "synchronized diffusions. NeurIPS.",
    ),
    "stoch-sync": (
        "Yeo, Kim, Sung (2025). StochSync: stochastic diffusion synchronization for image "
        "generation in arbitrary spaces. ICLR.",
    ),
    "sds": (
        "Poole, Jain, Barron, Mildenhall (2023). DreamFusion: text-to-3D using 2D diffusion. ICLR.",
        _MAS,
    ),
    "mh": (
        "Metropolis et al. (1953). Equation of state calculations by fast computing machines. "
        "J. Chem. Phys. 21.",
        "Hastings (1970). Monte Carlo sampling methods using Markov chains and their applications. "
        "Biometrika 57.",
        "Haario, Saksman, Tamminen (2001). An adaptive Metropolis algorithm. Bernoulli 7.",
    ),
    "nuts": (
        "Hoffman, Gelman (2014). The No-U-Turn sampler. JMLR 15.",
        "Phan, Pradhan, Jankowiak (2019). Composable effects for flexible and accelerated "
        "probabilistic programming in NumPyro. arXiv:1912.11554.",
    ),
    "dvae": (
        "Fiche, Leglaive, Alameda-Pineda, Séguier (2023). Motion-DVAE: unsupervised learning for "
        "fast human motion denoising. MIG.",
        "Sohn, Yan, Lee (2015). Learning structured output representation using deep conditional "
        "generative models. NeurIPS.",
    ),
    "ensemble": (
        "Goodman, Weare (2010). Ensemble samplers with affine invariance. CAMCoS 5.",
        "Foreman-Mackey, Hogg, Lang, Goodman (2013). emcee: the MCMC hammer. PASP 125.",
    ),
    "tempered": (
        "Syed, Bouchard-Côté, Deligiannidis, Doucet (2022). Non-reversible parallel tempering: a "
        "scalable highly parallel MCMC scheme. JRSS B 84.",
        _HMC,
    ),
    "tempered-pairs": (
        "Syed, Bouchard-Côté, Deligiannidis, Doucet (2022). Non-reversible parallel tempering: a "
        "scalable highly parallel MCMC scheme. JRSS B 84.",
        "Liu (2001). Monte Carlo strategies in scientific computing. Springer.",
        "Christen, Fox (2005). Markov chain Monte Carlo using an approximation. J. Comput. Graph. "
        "Stat. 14.",
    ),
    "smc": (
        "Del Moral, Doucet, Jasra (2006). Sequential Monte Carlo samplers. JRSS B 68.",
        "Neal (2001). Annealed importance sampling. Statistics and Computing 11.",
        "Zhou, Johansen, Aston (2016). Toward automatic model comparison: an adaptive sequential "
        "Monte Carlo approach. J. Comput. Graph. Stat. 25.",
        _HMC,
    ),
}
"""References by sampler name, without probmotion itself."""

OF_SETTINGS: Mapping[str, tuple[str, ...]] = {
    '"pseudo_marginal": true': (
        "Andrieu, Roberts (2009). The pseudo-marginal approach for efficient Monte Carlo "
        "computations. Annals of Statistics 37.",
    ),
}
"""References by fragment of the JSON text of the settings."""

POSE_PAIRS = (
    "Yin, Huang, Ho, Wang, Komura, Cohen-Or, Zhang (2018). A sampling approach to generating "
    "closely interacting 3D pose-pairs from 2D annotations. IEEE TVCG.",
    "Akhter, Black (2015). Pose-conditioned joint angle limits for 3D human pose "
    "reconstruction. CVPR.",
)
"""References for draws of interacting people."""


def citations_of(sampler: str, settings: str = "", people: int = 1) -> list[str]:
    """Return the references for draws of a sampler; probmotion alone if the sampler is unknown.

    ``settings`` are the sampler's settings as JSON, ``people`` the number of people in the motion.
    """
    extra = [work for text, works in OF_SETTINGS.items() if text in settings for work in works]
    pairs = POSE_PAIRS if people > 1 and sampler == "mh" else ()
    return [*CITATIONS.get(sampler, ()), *extra, *pairs, _OURS]

from .diffusion.motion_diffusion import MotionDiffusion as MotionDiffusion
from .dvae.motion_dvae import MotionDVAE as MotionDVAE
from .mixture.gaussian_mixture import GaussianMixtureMotion as GaussianMixtureMotion
from .mixture.spectral_mixture import SpectralMixtureMotion as SpectralMixtureMotion
from .unseen_depth.annotation_prior import AnnotationPrior as AnnotationPrior
from .vae.motion_vae import MotionVAE as MotionVAE

from .denoiser_training import (
    DenoiserTrainee as DenoiserTrainee,
    usual_denoiser_training as usual_denoiser_training,
)
from .joint_corrector import JointCorrector as JointCorrector
from .joint_noise import JointNoise as JointNoise
from .motion_denoiser import MotionDenoiser as MotionDenoiser
from .motion_dvae import MotionDVAE as MotionDVAE
from .settings import DVAESettings as DVAESettings
from .training import (
    DVAETrainee as DVAETrainee,
    refit_joint_scale as refit_joint_scale,
    usual_dvae_training as usual_dvae_training,
)
from .variational_terms import gaussian_kl as gaussian_kl

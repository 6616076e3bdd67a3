from .motion_diffusion import KIND as KIND, MotionDiffusion as MotionDiffusion
from .motion_transformer import MotionTransformer as MotionTransformer, sinusoids as sinusoids
from .projected_denoiser import denoiser_of as denoiser_of
from .settings import DiffusionSettings as DiffusionSettings
from .track_denoising import denoise_track as denoise_track
from .training import DiffusionTrainee as DiffusionTrainee, usual_training as usual_training

from .motion_diffusion import MotionDiffusion as MotionDiffusion
from .projected_denoiser import denoiser_of as denoiser_of
from .settings import DiffusionSettings as DiffusionSettings
from .track_denoising import denoise_track as denoise_track
from .training import DiffusionTrainee as DiffusionTrainee, usual_training as usual_training

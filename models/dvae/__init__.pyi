from .denoiser_training import (
    DenoiserTrainee as DenoiserTrainee,
    usual_denoiser_training as usual_denoiser_training,
)
from .encoders import (
    Evidence as Evidence,
    JointEncoder as JointEncoder,
    TrackingEncoder as TrackingEncoder,
)
from .inference import (
    Bound as Bound,
    Denoiser as Denoiser,
    DenoisingNetworks as DenoisingNetworks,
    Inferred as Inferred,
)
from .joint_noise import JointNoise as JointNoise, Noisy as Noisy
from .latent_rollouts import (
    Generative as Generative,
    Inference as Inference,
    Rollout as Rollout,
    rollout as rollout,
)
from .layers import (
    State as State,
    mean_and_log_scale as mean_and_log_scale,
    numbers_read as numbers_read,
    perceptron as perceptron,
    trust_in as trust_in,
)
from .motion_denoiser import (
    KIND as KIND,
    MotionDenoiser as MotionDenoiser,
    NoisyMotion as NoisyMotion,
)
from .motion_dvae import MotionDVAE as MotionDVAE, description_of as description_of
from .motion_windows import MotionWindows as MotionWindows, Windows as Windows
from .network import PARTS as PARTS, DVAEModel as DVAEModel, DVAENetwork as DVAENetwork
from .noisy_windows import (
    NoisyWindows as NoisyWindows,
    Stitching as Stitching,
    rough_placement as rough_placement,
)
from .settings import DVAESettings as DVAESettings
from .training import (
    DVAETrainee as DVAETrainee,
    refit_joint_scale as refit_joint_scale,
    usual_dvae_training as usual_dvae_training,
)
from .variational_terms import (
    expected_log_normal as expected_log_normal,
    gaussian_kl as gaussian_kl,
    inverse_gamma_kl as inverse_gamma_kl,
    log_normal as log_normal,
)

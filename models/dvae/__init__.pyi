from .denoiser_training import (
    DenoiserTrainee as DenoiserTrainee,
)
from .denoiser_training import (
    usual_denoiser_training as usual_denoiser_training,
)
from .encoders import (
    Evidence as Evidence,
)
from .encoders import (
    JointEncoder as JointEncoder,
)
from .encoders import (
    TrackingEncoder as TrackingEncoder,
)
from .inference import (
    Bound as Bound,
)
from .inference import (
    Denoiser as Denoiser,
)
from .inference import (
    DenoisingNetworks as DenoisingNetworks,
)
from .inference import (
    Inferred as Inferred,
)
from .joint_noise import JointNoise as JointNoise
from .joint_noise import Noisy as Noisy
from .latent_rollouts import (
    Generative as Generative,
)
from .latent_rollouts import (
    Inference as Inference,
)
from .latent_rollouts import (
    Rollout as Rollout,
)
from .latent_rollouts import (
    rollout as rollout,
)
from .layers import (
    State as State,
)
from .layers import (
    mean_and_log_scale as mean_and_log_scale,
)
from .layers import (
    numbers_read as numbers_read,
)
from .layers import (
    perceptron as perceptron,
)
from .layers import (
    trust_in as trust_in,
)
from .motion_denoiser import (
    KIND as KIND,
)
from .motion_denoiser import (
    MotionDenoiser as MotionDenoiser,
)
from .motion_denoiser import (
    NoisyMotion as NoisyMotion,
)
from .motion_dvae import MotionDVAE as MotionDVAE
from .motion_dvae import description_of as description_of
from .motion_windows import MotionWindows as MotionWindows
from .motion_windows import Windows as Windows
from .network import PARTS as PARTS
from .network import DVAEModel as DVAEModel
from .network import DVAENetwork as DVAENetwork
from .noisy_windows import (
    NoisyWindows as NoisyWindows,
)
from .noisy_windows import (
    Stitching as Stitching,
)
from .noisy_windows import (
    rough_placement as rough_placement,
)
from .settings import DVAESettings as DVAESettings
from .training import (
    DVAETrainee as DVAETrainee,
)
from .training import (
    refit_joint_scale as refit_joint_scale,
)
from .training import (
    usual_dvae_training as usual_dvae_training,
)
from .variational_terms import (
    expected_log_normal as expected_log_normal,
)
from .variational_terms import (
    gaussian_kl as gaussian_kl,
)
from .variational_terms import (
    inverse_gamma_kl as inverse_gamma_kl,
)
from .variational_terms import (
    log_normal as log_normal,
)

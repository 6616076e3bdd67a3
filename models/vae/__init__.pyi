from .inference import SeenLatent as SeenLatent
from .inference import VAEEncoder as VAEEncoder
from .layers import (
    FRAMES_AT_ONCE as FRAMES_AT_ONCE,
)
from .layers import (
    BoneDecoder as BoneDecoder,
)
from .layers import (
    FrameEncoder as FrameEncoder,
)
from .layers import (
    ImageFeatures as ImageFeatures,
)
from .layers import (
    Readout as Readout,
)
from .layers import (
    TransformerLayer as TransformerLayer,
)
from .layers import (
    body_size as body_size,
)
from .layers import (
    check_frames as check_frames,
)
from .layers import (
    mixed_precision as mixed_precision,
)
from .losses import (
    best_guess as best_guess,
)
from .losses import (
    guess_terms as guess_terms,
)
from .losses import (
    pictured as pictured,
)
from .losses import (
    reconstruction as reconstruction,
)
from .losses import (
    roughness as roughness,
)
from .losses import (
    weighted_sum as weighted_sum,
)
from .model import (
    KIND as KIND,
)
from .model import (
    MotionVAEModel as MotionVAEModel,
)
from .model import (
    ReadModel as ReadModel,
)
from .model import (
    description_of as description_of,
)
from .model import (
    read_model as read_model,
)
from .motion_vae import MotionVAE as MotionVAE
from .network import (
    FrameMap as FrameMap,
)
from .network import (
    MotionVAENetwork as MotionVAENetwork,
)
from .network import (
    TimeDecoder as TimeDecoder,
)
from .network import (
    TimeEncoder as TimeEncoder,
)
from .observed_views import EvidencePicture as EvidencePicture
from .observed_views import picture_of as picture_of
from .pose_network import PoseGuesses as PoseGuesses
from .pose_network import PoseNetwork as PoseNetwork
from .rigid_paths import RigidPath as RigidPath
from .rigid_paths import SeenBody as SeenBody
from .rigid_paths import see_body as see_body
from .settings import USUAL_THRESHOLD as USUAL_THRESHOLD
from .settings import MotionVAESettings as MotionVAESettings
from .teacher_forcing import TaughtPoses as TaughtPoses
from .teacher_forcing import scaled as scaled
from .training import (
    MotionVAETrainee as MotionVAETrainee,
)
from .training import (
    PoseTrainee as PoseTrainee,
)
from .training import (
    usual_motion_vae_training as usual_motion_vae_training,
)
from .transition_latents import (
    greatest_acceleration as greatest_acceleration,
)
from .transition_latents import (
    long_motion as long_motion,
)
from .view_hypotheses import (
    JudgedHypotheses as JudgedHypotheses,
)
from .view_hypotheses import (
    judge_hypotheses as judge_hypotheses,
)

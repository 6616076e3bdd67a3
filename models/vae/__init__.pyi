from .inference import SeenLatent as SeenLatent, VAEEncoder as VAEEncoder
from .layers import (
    FRAMES_AT_ONCE as FRAMES_AT_ONCE,
    BoneDecoder as BoneDecoder,
    FrameEncoder as FrameEncoder,
    ImageFeatures as ImageFeatures,
    Readout as Readout,
    TransformerLayer as TransformerLayer,
    body_size as body_size,
    check_frames as check_frames,
    mixed_precision as mixed_precision,
)
from .losses import (
    best_guess as best_guess,
    guess_terms as guess_terms,
    pictured as pictured,
    reconstruction as reconstruction,
    roughness as roughness,
    weighted_sum as weighted_sum,
)
from .model import (
    KIND as KIND,
    MotionVAEModel as MotionVAEModel,
    ReadModel as ReadModel,
    description_of as description_of,
    read_model as read_model,
)
from .motion_vae import MotionVAE as MotionVAE
from .network import (
    FrameMap as FrameMap,
    MotionVAENetwork as MotionVAENetwork,
    TimeDecoder as TimeDecoder,
    TimeEncoder as TimeEncoder,
)
from .observed_views import ObservedView as ObservedView, picture_of as picture_of
from .pose_network import PoseGuesses as PoseGuesses, PoseNetwork as PoseNetwork
from .rigid_paths import RigidPath as RigidPath, SeenBody as SeenBody, see_body as see_body
from .settings import USUAL_THRESHOLD as USUAL_THRESHOLD, MotionVAESettings as MotionVAESettings
from .teacher_forcing import TeacherForcedPoses as TeacherForcedPoses, scaled as scaled
from .training import (
    MotionVAETrainee as MotionVAETrainee,
    PoseTrainee as PoseTrainee,
    usual_motion_vae_training as usual_motion_vae_training,
)
from .transition_latents import (
    greatest_acceleration as greatest_acceleration,
    long_motion as long_motion,
)
from .view_hypotheses import (
    JudgedHypotheses as JudgedHypotheses,
    judge_hypotheses as judge_hypotheses,
)

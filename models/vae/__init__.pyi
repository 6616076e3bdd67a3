from .inference import VAEEncoder as VAEEncoder
from .losses import (
    best_hypothesis as best_hypothesis,
    hypothesis_losses as hypothesis_losses,
    project_to_image as project_to_image,
    weighted_sum as weighted_sum,
)
from .motion_vae import MotionVAE as MotionVAE
from .network import MotionVAEModel as MotionVAEModel, MotionVAENetwork as MotionVAENetwork
from .pose_network import PoseHypotheses as PoseHypotheses, PoseNetwork as PoseNetwork
from .rigid_paths import (
    BodyEstimate as BodyEstimate,
    RigidPath as RigidPath,
    estimate_body as estimate_body,
)
from .settings import MotionVAESettings as MotionVAESettings
from .teacher_forcing import TeacherForcedPoses as TeacherForcedPoses
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
    HypothesisAccuracy as HypothesisAccuracy,
    evaluate_hypotheses as evaluate_hypotheses,
)

from .evaluator import (
    KIND as KIND,
    EvaluatorSettings as EvaluatorSettings,
    TrackEvaluator as TrackEvaluator,
)
from .evaluator_training import EvaluatorTrainee as EvaluatorTrainee
from .lifter import (
    LifterNetwork as LifterNetwork,
    LifterSettings as LifterSettings,
    PoseLifter as PoseLifter,
    project_points as project_points,
    raise_points as raise_points,
)
from .lifter_training import (
    LifterTrainee as LifterTrainee,
    LossWeights as LossWeights,
    bone_sizes as bone_sizes,
    lifting_losses as lifting_losses,
)
from .pose_flow import (
    CouplingFlow as CouplingFlow,
    FlowSettings as FlowSettings,
    PoseFlow as PoseFlow,
)
from .pose_flow_training import PoseFlowTrainee as PoseFlowTrainee, whole_poses as whole_poses
from .track_autoencoder import (
    TrackAutoencoder as TrackAutoencoder,
    TrackDecoder as TrackDecoder,
    TrackEncoder as TrackEncoder,
    divergence_from_normal as divergence_from_normal,
)

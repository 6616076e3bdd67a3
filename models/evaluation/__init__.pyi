from .evaluator import (
    KIND as KIND,
)
from .evaluator import (
    EvaluatorSettings as EvaluatorSettings,
)
from .evaluator import (
    TrackEvaluator as TrackEvaluator,
)
from .evaluator_training import EvaluatorTrainee as EvaluatorTrainee
from .lifter import (
    LifterNetwork as LifterNetwork,
)
from .lifter import (
    LifterSettings as LifterSettings,
)
from .lifter import (
    PoseLifter as PoseLifter,
)
from .lifter import (
    project_points as project_points,
)
from .lifter import (
    raise_points as raise_points,
)
from .lifter_training import (
    LifterTrainee as LifterTrainee,
)
from .lifter_training import (
    LossWeights as LossWeights,
)
from .lifter_training import (
    bone_sizes as bone_sizes,
)
from .lifter_training import (
    lifting_losses as lifting_losses,
)
from .pose_flow import (
    CouplingFlow as CouplingFlow,
)
from .pose_flow import (
    FlowSettings as FlowSettings,
)
from .pose_flow import (
    PoseFlow as PoseFlow,
)
from .pose_flow_training import PoseFlowTrainee as PoseFlowTrainee
from .pose_flow_training import whole_poses as whole_poses
from .track_autoencoder import (
    TrackAutoencoder as TrackAutoencoder,
)
from .track_autoencoder import (
    TrackDecoder as TrackDecoder,
)
from .track_autoencoder import (
    TrackEncoder as TrackEncoder,
)
from .track_autoencoder import (
    divergence_from_normal as divergence_from_normal,
)

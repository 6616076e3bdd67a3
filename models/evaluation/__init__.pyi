from .evaluator import EvaluatorSettings as EvaluatorSettings, TrackEvaluator as TrackEvaluator
from .evaluator_training import EvaluatorTrainee as EvaluatorTrainee
from .lifter import LifterSettings as LifterSettings, PoseLifter as PoseLifter
from .lifter_training import LifterTrainee as LifterTrainee, LossWeights as LossWeights
from .pose_flow import FlowSettings as FlowSettings, PoseFlow as PoseFlow
from .pose_flow_training import PoseFlowTrainee as PoseFlowTrainee

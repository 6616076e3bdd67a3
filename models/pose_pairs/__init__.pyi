from .joint_limits import JointLimits as JointLimits
from .joint_limits_learning import learn_limits as learn_limits
from .pair_posterior import PairSettings as PairSettings
from .penetration import (
    penetrating_bones as penetrating_bones,
    penetration_depth as penetration_depth,
)
from .pose_chart import PoseChart as PoseChart
from .pose_pairs import PosePairPrior as PosePairPrior
from .single_pose_lifting import lift_people as lift_people, lift_person as lift_person

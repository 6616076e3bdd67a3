from .joint_limits import JointLimits as JointLimits, sphere_rings as sphere_rings
from .joint_limits_frames import (
    NO_LENGTH as NO_LENGTH,
    Frame as Frame,
    Vector as Vector,
    cell_of as cell_of,
    closeness_of as closeness_of,
    from_frame as from_frame,
    in_frame as in_frame,
    least_rotation as least_rotation,
    line_frame as line_frame,
    product as product,
    unit as unit,
)
from .joint_limits_kernels import (
    PARTS as PARTS,
    LimitArrays as LimitArrays,
    local_directions as local_directions,
    project_poses as project_poses,
)
from .joint_limits_learning import (
    HELD_OUT as HELD_OUT,
    clips_of_people as clips_of_people,
    learn_limits as learn_limits,
    main as main,
    rejected_fractions as rejected_fractions,
)
from .pair_posterior import PairSettings as PairSettings
from .penetration import (
    Capsules as Capsules,
    capsules_of as capsules_of,
    penetrating_bones as penetrating_bones,
    penetration_depth as penetration_depth,
)
from .penetration_kernels import (
    depths_of_pairs as depths_of_pairs,
    segment_distance as segment_distance,
    total_depths as total_depths,
)
from .pose_chart import PoseChart as PoseChart
from .pose_pairs import PosePairPrior as PosePairPrior
from .single_pose_lifting import lift_people as lift_people

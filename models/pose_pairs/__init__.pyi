from .joint_limits import JointLimits as JointLimits
from .joint_limits import sphere_rings as sphere_rings
from .joint_limits_frames import (
    NO_LENGTH as NO_LENGTH,
)
from .joint_limits_frames import (
    Frame as Frame,
)
from .joint_limits_frames import (
    Vector as Vector,
)
from .joint_limits_frames import (
    cell_of as cell_of,
)
from .joint_limits_frames import (
    closeness_of as closeness_of,
)
from .joint_limits_frames import (
    from_frame as from_frame,
)
from .joint_limits_frames import (
    in_frame as in_frame,
)
from .joint_limits_frames import (
    least_rotation as least_rotation,
)
from .joint_limits_frames import (
    line_frame as line_frame,
)
from .joint_limits_frames import (
    product as product,
)
from .joint_limits_frames import (
    unit as unit,
)
from .joint_limits_kernels import (
    PARTS as PARTS,
)
from .joint_limits_kernels import (
    LimitArrays as LimitArrays,
)
from .joint_limits_kernels import (
    local_directions as local_directions,
)
from .joint_limits_kernels import (
    project_poses as project_poses,
)
from .joint_limits_learning import (
    HELD_OUT as HELD_OUT,
)
from .joint_limits_learning import (
    clips_of_people as clips_of_people,
)
from .joint_limits_learning import (
    learn_limits as learn_limits,
)
from .joint_limits_learning import (
    main as main,
)
from .joint_limits_learning import (
    rejected_shares as rejected_shares,
)
from .pair_posterior import PairSettings as PairSettings
from .penetration import (
    Capsules as Capsules,
)
from .penetration import (
    capsules_of as capsules_of,
)
from .penetration import (
    penetrating_bones as penetrating_bones,
)
from .penetration import (
    penetration_depth as penetration_depth,
)
from .penetration_kernels import (
    depths_of_pairs as depths_of_pairs,
)
from .penetration_kernels import (
    segment_distance as segment_distance,
)
from .penetration_kernels import (
    total_depths as total_depths,
)
from .pose_chart import PoseChart as PoseChart
from .pose_pairs import PosePairPrior as PosePairPrior
from .single_pose_lifting import lift_people as lift_people

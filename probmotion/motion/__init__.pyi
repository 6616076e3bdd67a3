from .camera_trajectories import (
    CameraTrajectory as CameraTrajectory,
)
from .camera_trajectories import (
    fit_trajectory as fit_trajectory,
)
from .camera_trajectories import (
    geman_mcclure as geman_mcclure,
)
from .distances import (
    NearestDistances as NearestDistances,
)
from .distances import (
    mirror_share as mirror_share,
)
from .distances import (
    nearest_distances as nearest_distances,
)
from .distances import (
    windows as windows,
)
from .distances import (
    yaw_aligned_distances as yaw_aligned_distances,
)
from .joint_names import (
    canonical_name as canonical_name,
)
from .joint_names import (
    canonical_names as canonical_names,
)
from .joint_names import (
    mirrored_name as mirrored_name,
)
from .kinematics import fit_rotations as fit_rotations
from .kinematics import forward_kinematics as forward_kinematics
from .motion import KeypointTrack as KeypointTrack
from .motion import Motion as Motion
from .occlusion import joints_at_rate as joints_at_rate
from .occlusion import joints_on_skeleton as joints_on_skeleton
from .presets import PRESETS as PRESETS
from .presets import Preset as Preset
from .resampling import resample as resample
from .rest_poses import estimate_rest_pose as estimate_rest_pose
from .rest_poses import is_four_legged as is_four_legged
from .retargeting import common_skeleton as common_skeleton
from .retargeting import matching_joints as matching_joints
from .skeleton import Skeleton as Skeleton
from .splits import (
    Split as Split,
)
from .splits import (
    clip_of as clip_of,
)
from .splits import (
    name_within_clip as name_within_clip,
)
from .splits import (
    split_clips as split_clips,
)
from .splits import (
    tracks_of_clips as tracks_of_clips,
)

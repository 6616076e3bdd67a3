from .camera_trajectories import (
    CameraTrajectory as CameraTrajectory,
    fit_trajectory as fit_trajectory,
)
from .distances import (
    mirrored_fraction as mirrored_fraction,
    nearest_distances as nearest_distances,
    windows as windows,
    yaw_aligned_distances as yaw_aligned_distances,
)
from .inverse_kinematics import rigid_motion as rigid_motion
from .joint_names import canonical_names as canonical_names, mirrored_name as mirrored_name
from .kinematics import fit_rotations as fit_rotations, forward_kinematics as forward_kinematics
from .motion import (
    JointTrack as JointTrack,
    KeypointTrack as KeypointTrack,
    Motion as Motion,
)
from .occlusion import joints_at_rate as joints_at_rate, joints_on_skeleton as joints_on_skeleton
from .presets import PRESETS as PRESETS
from .resampling import resample as resample
from .rest_poses import estimate_rest_pose as estimate_rest_pose, is_four_legged as is_four_legged
from .retargeting import common_skeleton as common_skeleton
from .skeleton import Skeleton as Skeleton
from .splits import (
    Split as Split,
    clip_of as clip_of,
    name_within_clip as name_within_clip,
    split_clips as split_clips,
    tracks_of_clips as tracks_of_clips,
)

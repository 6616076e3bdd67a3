from .acclaim_text import AcclaimText as AcclaimText, Line as Line
from .amc import read_amc as read_amc
from .asf import AcclaimSkeleton as AcclaimSkeleton, read_asf as read_asf
from .bvh import read_bvh as read_bvh
from .bvh_parsing import (
    FRAME_TIMES as FRAME_TIMES,
    BVHContent as BVHContent,
    BVHJoint as BVHJoint,
    parse_bvh as parse_bvh,
)
from .bvh_writing import write_bvh as write_bvh
from .deeplabcut import read_deeplabcut as read_deeplabcut
from .errors import (
    MotionFileError as MotionFileError,
    MotionFileWarning as MotionFileWarning,
    read_bytes as read_bytes,
    shortened as shortened,
)
from .files import (
    files_named as files_named,
    load_motion as load_motion,
    load_motions as load_motions,
    read_keypoints as read_keypoints,
    read_motion as read_motion,
    save_motion as save_motion,
)
from .keypoint_json import read_keypoint_json as read_keypoint_json
from .keypoint_layouts import LAYOUTS as LAYOUTS, keypoint_skeleton as keypoint_skeleton
from .keypoint_linking import link_people as link_people
from .keypoint_tracks import (
    Detection as Detection,
    Frames as Frames,
    frame_number as frame_number,
    keypoint_values as keypoint_values,
    natural as natural,
    tracks_of as tracks_of,
)
from .npz import (
    read_keypoint_npz as read_keypoint_npz,
    read_npz as read_npz,
    write_npz as write_npz,
)
from .predictions import read_predictions as read_predictions
from .recordings import (
    Recording as Recording,
    read_recording as read_recording,
    triangulate_seen as triangulate_seen,
    undistorted as undistorted,
)

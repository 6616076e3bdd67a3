from .acclaim_text import AcclaimText as AcclaimText
from .acclaim_text import Line as Line
from .amc import read_amc as read_amc
from .asf import AcclaimSkeleton as AcclaimSkeleton
from .asf import read_asf as read_asf
from .bvh import read_bvh as read_bvh
from .bvh_parsing import (
    FRAME_TIMES as FRAME_TIMES,
)
from .bvh_parsing import (
    BVHContent as BVHContent,
)
from .bvh_parsing import (
    BVHJoint as BVHJoint,
)
from .bvh_parsing import (
    parse_bvh as parse_bvh,
)
from .bvh_writing import write_bvh as write_bvh
from .deeplabcut import read_deeplabcut as read_deeplabcut
from .errors import (
    MotionFileError as MotionFileError,
)
from .errors import (
    MotionFileWarning as MotionFileWarning,
)
from .errors import (
    read_bytes as read_bytes,
)
from .errors import (
    shortened as shortened,
)
from .files import (
    files_named as files_named,
)
from .files import (
    load_motion as load_motion,
)
from .files import (
    load_motions as load_motions,
)
from .files import (
    read_keypoints as read_keypoints,
)
from .files import (
    read_motion as read_motion,
)
from .files import (
    save_motion as save_motion,
)
from .keypoint_json import read_keypoint_json as read_keypoint_json
from .keypoint_layouts import LAYOUTS as LAYOUTS
from .keypoint_layouts import keypoint_skeleton as keypoint_skeleton
from .keypoint_linking import link_people as link_people
from .keypoint_tracks import (
    Detection as Detection,
)
from .keypoint_tracks import (
    Frames as Frames,
)
from .keypoint_tracks import (
    frame_number as frame_number,
)
from .keypoint_tracks import (
    keypoint_values as keypoint_values,
)
from .keypoint_tracks import (
    natural as natural,
)
from .keypoint_tracks import (
    tracks_of as tracks_of,
)
from .npz import (
    read_keypoint_npz as read_keypoint_npz,
)
from .npz import (
    read_npz as read_npz,
)
from .npz import (
    write_npz as write_npz,
)
from .predictions import read_predictions as read_predictions
from .recordings import (
    Recording as Recording,
)
from .recordings import (
    read_recording as read_recording,
)
from .recordings import (
    triangulate_seen as triangulate_seen,
)
from .recordings import (
    undistorted as undistorted,
)

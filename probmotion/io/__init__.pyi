from .amc import read_amc as read_amc
from .asf import AcclaimSkeleton as AcclaimSkeleton, read_asf as read_asf
from .body_mesh import BodyMesh as BodyMesh
from .bvh import read_bvh as read_bvh
from .bvh_writing import write_bvh as write_bvh
from .errors import MotionFileError as MotionFileError, MotionFileWarning as MotionFileWarning
from .files import (
    files_named as files_named,
    load as load,
    load_all as load_all,
    read_joints as read_joints,
    save as save,
)
from .glb import write_glb as write_glb
from .markers import read_c3d as read_c3d, read_trc as read_trc
from .npz import (
    read_joint_npz as read_joint_npz,
    read_keypoint_npz as read_keypoint_npz,
    read_npz as read_npz,
    write_npz as write_npz,
)
from .predictions import read_predictions as read_predictions
from .recordings import Recording as Recording, read_recording as read_recording
from .smpl import smpl_motion as smpl_motion
from .tables import write_csv as write_csv, write_trc as write_trc

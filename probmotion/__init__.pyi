from . import models as models, samplers as samplers
from .calibration.grid import calibrate as calibrate
from .comparison.functions import (
    Score as Score,
    posterior as posterior,
    problem as problem,
    sample as sample,
    score as score,
)
from .comparison.grid import Comparison as Comparison, compare as compare
from .geometry.cameras import Cameras as Cameras
from .geometry.triangulation import triangulate as triangulate
from .io.files import (
    load as load,
    load_all as load_all,
    read_joints as read_joints,
    save as save,
)
from .io.keypoints.files import read_keypoints as read_keypoints
from .lifting.pairs import LiftedPairs as LiftedPairs, lift_pairs as lift_pairs
from .lifting.recording_lift import lift as lift
from .lifting.result import Lift as Lift
from .motion.motion import (
    JointTrack as JointTrack,
    KeypointTrack as KeypointTrack,
    Motion as Motion,
)
from .motion.skeleton import Skeleton as Skeleton
from .posteriors.draws import MotionDraws as MotionDraws
from .posteriors.likelihoods import Joints3D as Joints3D, Keypoints2D as Keypoints2D
from .posteriors.noise_schedule import NoiseSchedule as NoiseSchedule
from .posteriors.posterior import MotionPosterior as MotionPosterior
from .posteriors.sampling import Sampler as Sampler, UnsupportedPosterior as UnsupportedPosterior
from .posteriors.streams import open_draws as open_draws
from .reconstruction.inference import reconstruct as reconstruct
from .reconstruction.result import Reconstruction as Reconstruction

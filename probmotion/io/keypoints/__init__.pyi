from .calibration import Calibration as Calibration, read_calibration as read_calibration
from .files import open_keypoints as open_keypoints, read_keypoints as read_keypoints
from .tracks import KeypointFile as KeypointFile

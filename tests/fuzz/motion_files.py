"""Small valid motion and keypoint files of every format."""

import io
import json
import pickle

import h5py
import numpy as np

from probmotion.motion.presets import PRESETS

BVH = b"""HIERARCHY
ROOT Hips {
    OFFSET 0 0 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
    JOINT Knee {
        OFFSET 0 -1 0
        CHANNELS 4 Zrotation Yposition Yrotation Xrotation
        End Site { OFFSET 0 -0.5 0 }
    }
}
ROOT Ball {
    OFFSET 0 0 1
    CHANNELS 0
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 1 0 90 0 0 0 0 0 90
1.5e0 1 0 -90 .25 0 -.5 0 0 90
"""
ASF = (
    b":units\nlength 1\nangle deg\n:root\norder TX RY\n:bonedata\nbegin\nname leg\nlength 1\n"
    b"direction 0 -1 0\naxis 0 90 0 XYZ\ndof rz\nend\n:hierarchy\nbegin\nroot leg\nend\n"
)
AMC = b":FULLY-SPECIFIED\n:DEGREES\n1\nroot 1 90\nleg 45\n2\nroot 0 0\nleg 1.5e0\n"


MOTION = {
    "positions": np.arange(24.0).reshape(4, 2, 3),
    "joint_names": np.array(["hip", "knee"]),
    "parents": np.array([-1, 0], dtype=np.int32),
    "fps": 30,
    "up_axis": "y",
}
PERSON = [0.5 if i % 3 == 2 else float(i) for i in range(51)]
COCO = {
    "images": [{"id": 1, "file_name": "1.jpg"}, {"id": 2, "file_name": "2.jpg"}],
    "annotations": [
        {"image_id": i, "category_id": 1, "keypoints": [1, 2, 2] * 17, "track_id": 1}
        for i in (1, 2)
    ],
    "categories": [{"id": 1, "keypoints": [f"k{i}" for i in range(17)], "skeleton": [[1, 2]]}],
}
RESULTS = [{"image_id": f"{i}.jpg", "keypoints": PERSON, "idx": 1} for i in range(3)]
OPENPOSE = {"people": [{"person_id": [-1], "pose_keypoints_2d": PERSON}]}
ALPHAPOSE = {"1.jpg": OPENPOSE, "3.jpg": OPENPOSE}
CMU = {"1.jpg": {"bodies": [{"joints": PERSON}]}}
POINTS = [[float(i), 2.0] for i in range(17)]
INSTANCE = {"keypoints": POINTS, "keypoint_scores": [0.5] * 17, "bbox": [[0, 0, 9, 9]]}
MMPOSE = {
    "meta_info": {"keypoint_id2name": {str(i): f"k{i}" for i in range(17)}},
    "instance_info": [{"frame_id": i, "instances": [INSTANCE]} for i in (1, 2)],
}
RTMPOSE = {"fps": 30, "frames": [{"keypoints": [POINTS], "scores": [[0.5] * 17]}] * 2}
LANDMARKS = [{"x": 100.0 + i, "y": 200, "visibility": 0.9} for i in range(33)]
MEDIAPIPE = [{"timestamp_ms": 33 * i, "pose_landmarks": LANDMARKS} for i in range(2)]
JSONS = [
    json.dumps(content, indent=1).encode()
    for content in (
        *(COCO, RESULTS, OPENPOSE, ALPHAPOSE, CMU, [OPENPOSE, OPENPOSE]),
        *(MMPOSE, [INSTANCE], RTMPOSE, MEDIAPIPE),
    )
]
TABLE = b"""scorer,net,net,net,net,net
individuals,mouse,mouse,mouse,single,single
bodyparts,snout,snout,snout,corner,corner
coords,x,y,likelihood,x,y
7,1,2,0.5,0,9
8,nan,,,0,9
"""
LANDMARK_TABLE = "\n".join(
    ",".join(map(str, row))
    for row in (
        [
            "frame",
            *(f"{name}_{axis}" for name in PRESETS["mediapipe33"].joint_names for axis in "xyv"),
        ],
        # Pixels, and visibilities of 1.
        [0, *(1 if k % 3 == 2 else k for k in range(99))],
        [1, *(1 if k % 3 == 2 else k for k in range(99))],
    )
).encode()
CAMERAS = b"""[left]
name = "left"
size = [1920.0, 1080.0]
matrix = [[1500.0, 0.0, 960.0], [0.0, 1500.0, 540.0], [0.0, 0.0, 1.0]]
distortions = [0.1, -0.05, 0.001, 0.0]
rotation = [0.1, 1.2, -0.3]
translation = [0.1, 0.2, 3.0]
fisheye = false
[metadata]
error = 0.1
"""
JOINTS = PRESETS["person14"].joint_names
TRC = "\n".join(
    "\t".join(map(str, row))
    for row in (
        ["PathFileType", 4, "(X/Y/Z)", "walk.trc"],
        ["DataRate", "NumFrames", "NumMarkers", "Units"],
        [30, 2, 14, "m"],
        ["Frame#", "Time", *(cell for name in JOINTS for cell in (name, "", ""))],
        ["", "", *(f"{axis}{n}" for n in range(1, 15) for axis in "XYZ")],
        [1, 0, *np.linspace(0.1, 0.9, 42)],
        [2, 0.033, *np.linspace(0.1, 0.9, 39), "", "", ""],
    )
).encode()
ARCHIVES = []
for more in ({}, {"keypoints": np.zeros((4, 2, 2)), "confidence": np.ones((4, 2))}):
    file = io.BytesIO()
    np.savez(file, **MOTION, **more)
    ARCHIVES.append(file.getvalue())
HDF5 = []


def hdf5_of(group, datasets, **attributes):
    file = io.BytesIO()
    with h5py.File(file, "w") as archive:
        home = archive.require_group(group)
        home.attrs.update(attributes)
        for key, value in datasets.items():
            home[key] = value
        if "table" in home:
            columns = [("net", "snout", axis) for axis in ("x", "y", "likelihood")]
            home["table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(columns, 0))
        if "position" in home:
            for axis, name in enumerate(("time", "space", "keypoint", "individual")):
                home[name].make_scale(name)
                home["position"].dims[axis].attach_scale(home[name])
    HDF5.append(file.getvalue())


hdf5_of(
    "/",
    {
        "tracks": np.ones((1, 2, 3, 4)),
        "point_scores": np.ones((1, 3, 4)),
        "node_names": np.array([b"a", b"b", b"c"]),
        "edge_inds": np.array([[0, 1]]),
    },
)
hdf5_of(
    "/",
    {
        "position": np.ones((4, 2, 3, 1)),
        "time": np.arange(4.0),
        "space": np.array([b"x", b"y"]),
        "keypoint": np.array([b"a", b"b", b"c"]),
        "individual": np.array([b"a"]),
    },
    fps=25.0,
)
ROWS = np.ones(4, dtype=[("index", "<i8"), ("values_block_0", "<f8", (3,))])
ROWS["index"] = range(4)
hdf5_of("tracks", {"table": ROWS}, pandas_type=np.bytes_("frame_table"))

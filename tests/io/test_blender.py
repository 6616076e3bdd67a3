"""Files opened in Blender, whose package bpy requires a Python environment with NumPy 1."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from probmotion import Motion, Skeleton, save
from probmotion.data.synthetic.gaits import make_gait
from probmotion.motion.inverse_kinematics import rigid_motion

PYTHON = os.environ.get("BLENDER_PYTHON", sys.executable)
# Print the heads of the bones in all frames, by name, with Y up.
SCRIPT = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 24
if sys.argv[1].endswith("bvh"):
    bpy.ops.import_anim.bvh(filepath=sys.argv[1])
else:
    bpy.ops.import_scene.gltf(filepath=sys.argv[1])
(armature,) = (one for one in bpy.data.objects if one.type == "ARMATURE")
first, last = armature.animation_data.action.frame_range
heads = {bone.name: [] for bone in armature.pose.bones}
for frame in range(int(first), int(last) + 1):
    bpy.context.scene.frame_set(frame)
    posed = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    for bone in posed.pose.bones:
        x, y, z = posed.matrix_world @ bone.head
        heads[bone.name].append([x, z, -y])
json.dump(heads, open(sys.argv[2], "w"))
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["bvh", "glb"])
def test_blender_shows_the_rigid_motion(tmp_path, suffix):
    found = subprocess.run([PYTHON, "-c", "import bpy"], capture_output=True, check=False)
    if found.returncode:
        pytest.skip("Blender (the package bpy, of the interpreter BLENDER_PYTHON) is not installed")
    walk = make_gait("walk", frames=20, fps=24.0).retarget(Skeleton.preset("person14"))
    noise = np.random.default_rng(0).normal(scale=0.005, size=walk.positions.shape)
    motion = Motion(walk.positions + noise, walk.skeleton, walk.fps)
    path, shown = tmp_path / f"clip.{suffix}", tmp_path / "heads.json"
    save(motion, path)
    subprocess.run([PYTHON, "-c", SCRIPT, str(path), str(shown)], capture_output=True, check=True)
    heads, rigid = json.loads(shown.read_text()), rigid_motion(motion)
    for joint, name in enumerate(rigid.skeleton.joint_names):
        np.testing.assert_allclose(heads[name], rigid.positions[:, joint], atol=1e-3)

# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a video to Blender
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/08_from_video_to_blender.ipynb)
#
# `pm.lift` estimates 3D motion, with its uncertainty, from the 2D keypoints of one still camera. Here, the video is made,
# so that the truth is known: how right is the motion, do the intervals contain the truth, and what can one camera not
# tell?
#
# With a video of your own, a detector writes the keypoints, and one command does the rest:
#
#     probmotion lift keypoints.json --fps 30 --image-size 1920 1080 --out dance
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import probmotion as pm
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film, quadruped_as_person
from probmotion.plots.animation import animate_skeletons

# %% [markdown]
# ## 1. The keypoints
#
# A person walks past the camera for three seconds. The keypoints have the errors of detectors: noise of 4 pixels, 5 %
# outliers, 10 % missing, and frames in which left and right are exchanged. For your own, write
# `track = pm.read_keypoints("keypoints.json", fps=30)[0]`.

# %%
video = film(make_gait("walk", 3, frames=90), 0, azimuth=0.8, height=1.4)
track, truth = video.track, video.motion
print(f"{track.frames} frames at {track.fps:g} fps, {len(track.skeleton.joint_names)} keypoints")
print(f"missing: {(track.confidence[:, 5:] == 0).mean():.0%}")

fig, ax = plt.subplots(figsize=(8, 4.2))
for frame, colour in zip((0, 30, 60, 89), ("0.7", "tab:green", "tab:blue", "tab:red"), strict=True):
    points = track.keypoints[frame]
    for joint, parent in track.skeleton.bones:
        if joint > 5 and parent >= 5:  # without the face, which the made video lacks
            ax.plot(*points[[joint, parent]].T, color=colour, linewidth=1.5)
    ax.plot(*points.T, "o", color=colour, markersize=4, label=f"frame {frame}")
ax.set(xlim=(200, 1000), ylim=(860, 400), aspect="equal", xlabel="pixels", ylabel="pixels")
ax.legend(frameon=False, loc="lower left")
fig.tight_layout()

# %% [markdown]
# ## 2. The lift
#
# The result is a posterior: `mean` is a motion in metres, `draws` are 100 motions that explain the keypoints as well.
# The first sentence of the summary says whether to trust it. Every check compares a number with its limit.

# %%
result = pm.lift(track, image_size=video.size, progress=False)
print("\n".join(result.summary()))
pd.DataFrame(
    [(check.name, check.value, check.limit, check.passed) for check in result.checks],
    columns=["check", "value", "at most", "passed"],
).round(2)

# %% [markdown]
# From left to right: the mean, two draws and the truth. Drag to see them from the side, where the camera did not look.
# Pelvis and neck of the lift are those of motion capture; the made body has them elsewhere, so they are not compared below.

# %%
hips = [truth.skeleton.index(f"{side}_hip") for side in ("left", "right")]
shown = np.stack([result.mean.positions, *result.draws[:2], truth.positions])
shown -= shown[:, :, hips].mean(axis=2, keepdims=True)
animate_skeletons({"mean, two draws, truth": shown}, truth.skeleton, fps=truth.fps)

# %% [markdown]
# ## 3. Intervals and the truth
#
# The image shows two coordinates of a joint well, and its depth only through the lengths of bones and the habits of
# moving people. The intervals know that: they are wide in depth and narrow in the image.

# %%
joints = [j for j, name in enumerate(truth.skeleton.joint_names) if name not in ("pelvis", "neck")]


def about_hips(positions):
    """Return positions relative to the middle of the hips, of the twelve keypoints."""
    return (positions - positions[..., hips, :].mean(axis=-2, keepdims=True))[..., joints, :]


def millimetres(lift):
    """Return the mean error of a lift's joints about the hips."""
    error = about_hips(lift.mean.positions) - about_hips(truth.positions)
    return 1000 * np.linalg.norm(error, axis=-1).mean()


low, high = np.quantile(about_hips(result.draws), [0.05, 0.95], axis=0)
inside = (about_hips(truth.positions) >= low) & (about_hips(truth.positions) <= high)
print(f"mean error: {millimetres(result):.0f} mm; 90 % intervals contain {inside.mean():.0%}")

wrist = joints.index(truth.skeleton.index("left_wrist"))
seconds = np.arange(truth.frames) / truth.fps
fig, axes = plt.subplots(1, 2, figsize=(8, 2.8), sharex=True, sharey=True)
for ax, axis, name in zip(axes, (0, 2), ("across the image", "in depth"), strict=True):
    ax.fill_between(
        seconds,
        low[:, wrist, axis],
        high[:, wrist, axis],
        color="tab:orange",
        alpha=0.4,
        linewidth=0,
        label="90 % interval",
    )
    ax.plot(seconds, about_hips(result.draws)[:5, :, wrist, axis].T, color="tab:orange", lw=0.6)
    ax.plot(seconds, about_hips(truth.positions)[:, wrist, axis], color="black", label="truth")
    ax.set(title=f"left wrist, {name}", xlabel="time (s)")
axes[0].set_ylabel("from the hips (m)")
axes[1].legend(frameon=False)
fig.tight_layout()

# %% [markdown]
# ## 4. Take it home
#
# `save` writes a page for the browser (`lift.html`: open it on any device), the motion with rigid bones for Blender, all
# draws, and the joints of SMPL's body with rotations.
#
# In Blender: *File ▸ Import ▸ glTF 2.0* reads `lift.glb`, a body that moves; *File ▸ Import ▸ Motion Capture (.bvh)* reads
# `lift.bvh`, a skeleton for retargeting (forward −Z, up Y).

# %%
result.save("walk")
rigid = pm.load("walk/lift.bvh")
moved = rigid.positions[:, : truth.skeleton.n_joints] - result.mean.positions
print(f"rigid bones are {100 * np.median(np.linalg.norm(moved, axis=-1)):.1f} cm from the mean")
smpl = pm.load("walk/lift.smpl22.npz")
print(f"{smpl}, rotations {smpl.rotations.shape}")

# %% [markdown]
# ## 5. What one camera cannot tell
#
# A small person close to the camera looks like a tall one farther away, and so does a longer focal length. Without
# `--fov`, about 60° are assumed (which is right here); without `--height`, people are 1.7 m tall; without `--pitch`,
# the angle of the camera is estimated, less well for motion unlike the prior's.

# %%
hip_path = truth.positions[:, hips].mean(axis=1)
true_distance = np.linalg.norm(hip_path[:, [0, 2]], axis=-1).mean()
true_pitch = -np.degrees(np.arctan2(0.4, true_distance))  # it looks at a point 1 m above the floor
table = {}
for name, options in {
    "nothing given": {},
    "fov 40°": {"fov": 40.0},
    "fov 80°": {"fov": 80.0},
    "height 1.5 m": {"height": 1.5},
    "true pitch": {"pitch": float(true_pitch)},
    "pitch 15° wrong": {"pitch": float(true_pitch) - 15},
}.items():
    lift = pm.lift(track, image_size=video.size, draws=20, progress=False, **options)
    distance = np.linalg.norm(lift.mean.positions[:, 0, [0, 2]], axis=-1).mean()
    table[name] = {
        "distance, m": distance,
        "pitch, °": np.degrees(lift.camera.pitch),
        "error about the hips, mm": millimetres(lift),
        "trusted": lift.trusted,
    }
print(f"true distance {true_distance:.1f} m, true pitch {true_pitch:.0f}°")
pd.DataFrame(table).T.astype(float).round(1).astype({"trusted": bool})

# %% [markdown]
# ## 6. When not to trust it
#
# No person explains random keypoints, but some wrong videos do look like a person: a mark is a reason to look, and its
# absence is no proof. How often each kind is marked is measured in the guide to `probmotion lift`.

# %%
rng = np.random.default_rng(0)
seen = track.confidence[..., None] > 0
random = np.where(seen, rng.uniform(200, 800, track.keypoints.shape), np.nan)
animal = film(
    quadruped_as_person(make_gait("quadruped-trot", 1, frames=90)), 0, azimuth=1.0, height=0.8
)
for name, wrong in {
    "random keypoints": pm.KeypointTrack(random, track.confidence, track.skeleton, track.fps),
    "a trotting dog": animal.track,
}.items():
    print(f"{name}: {pm.lift(wrong, image_size=video.size, draws=2, progress=False).summary()[0]}")

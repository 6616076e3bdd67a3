# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From pictures of animals to new motion in 3D
#
# Nobody puts markers on a horse in the wild, but there are videos of it, and detectors that find
# its joints in them. A motion VAE (Sun et al. 2024, *Ponymation*) learns from such 2D tracks alone
# how a kind of body moves in 3D: it guesses poses, looks at their pictures, and is told how far off
# they are. `animal-vae` comes with the package; it learnt from pictures of dogs and of made
# quadrupeds that walk, trot, pace, canter and spin.

# %%
from dataclasses import replace

import numpy as np
import pandas as pd
from IPython.display import Image

import probmotion as pm
from probmotion.data.synthetic.animals import synthetic_animals
from probmotion.data.tracks.learning import film_clips
from probmotion.metrics import accuracy
from probmotion.models import MotionVAE
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee, PoseTrainee
from probmotion.models.vae.transition_latents import greatest_acceleration, long_motion
from probmotion.models.vae.view_hypotheses import judge_hypotheses
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.plots.animation import play_skeletons
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers import DVAEInference

prior = MotionVAE.load("animal-vae")
skeleton = prior.skeleton
print(skeleton.n_joints, "joints,", prior.frames, "frames at", prior.fps, "a second")

# %% [markdown]
# ## 1. What one has: tracks
#
# Eight animals that the prior has not seen are filmed from all sides. Of your own videos,
# `probmotion.io.read_keypoints` reads what DeepLabCut and other detectors write.

# %%
animals = synthetic_animals(8, seed=3)
tracks = film_clips(animals, skeleton, prior.fps, views=40).tracks
print(len(tracks), "tracks of", tracks[0].frames, "frames")

# %% [markdown]
# How the body is built is in its pictures: over many sides, what stands behind what follows from
# how widths vary together. No 3D is used; the last line compares with it.

# %%
body = ArticulatedBody(skeleton, estimate_rest_pose(tracks))
true = np.linalg.norm(
    [
        animals[0].positions[0, joint] - animals[0].positions[0, parent]
        for joint, parent in skeleton.bones
    ],
    axis=-1,
)
found = np.linalg.norm([body.rest[joint] for joint, _ in skeleton.bones], axis=-1)
print(f"bones are {100 * np.abs(found / true - 1).mean():.1f} % off in length, on average")

# %% [markdown]
# ## 2. Which view is right?
#
# A picture does not say whether a leg points towards the camera or away from it. The network makes
# four guesses, a quarter turn apart, and keeps the one that explains the pictures best with joints
# that bend as joints do. Against the truth:

# %%
judged = judge_hypotheses(
    prior.model.pose, prior.settings, prior.body, animals, n=300, fps=prior.fps
)
print(
    f"the right view wins in {judged.right:.0%}, depth is not mirrored in {judged.depth_right:.0%}"
)
print(f"joints are {1000 * judged.error:.0f} mm from the truth")

# %% [markdown]
# ## 3. New motions
#
# One latent code is one second of motion. Every draw is new; they stay in place, since where the
# animal goes is not in the code.

# %%
drawn = prior.sample(np.random.default_rng(0), 6)
draw_skeletons({"draws": drawn[:4]}, skeleton, "animals.png", moments=5, azimuth=np.pi / 2)
Image("animals.png")

# %% [markdown]
# Longer ones are made of several codes, with codes between them that are fitted to begin and end as
# their neighbours do. At a seam a joint should accelerate no more than within the pieces; where no
# transition is that smooth, `long_motion` warns. Here:

# %%
codes = prior.initial(np.random.default_rng(1), 4)
pieces = prior.motion(codes)
long = long_motion(prior, codes)
within = max(greatest_acceleration(piece) for piece in pieces)
share = greatest_acceleration(long) / within
print(f"{len(long)} frames; the greatest acceleration is {share:.2f} of that within pieces")

# %%
play_skeletons({"several codes": long[None]}, skeleton, "long.html", fps=prior.fps)

# %% [markdown]
# ## 4. What one camera saw
#
# With keypoints as evidence the same prior gives a posterior like any other. Where the body stands
# and looks is what its pose network sees; the code is inferred, here by the encoder, fitted to this
# one recording.

# %%
truth = animals[1].retarget(skeleton).resample(prior.fps).window(5, prior.frames).centred()
camera = pm.Cameras.around([0.9], [0.2], distance=7.0, perspective=True)
seen = pm.Keypoints2D.observe(truth, camera, noise=0.002, seed=0)
known = pm.MotionPosterior(prior.placed_by(seen), seen)
rows = {}
for mode in ("regression", "optimization"):
    draws = DVAEInference(mode=mode).sample(known, draws=50, seed=0, progress=False).flat()
    errors = accuracy.joint_errors(
        accuracy.aligned_by_root(draws.mean(axis=0), 0),
        accuracy.aligned_by_root(truth.positions, 0),
    )
    rows[mode] = {"error of the mean, mm": 1000 * errors.mean()}
print(pd.DataFrame(rows).T.round(0).to_string())

# %%
shown = {"drawn": drawn[:1], "seen by one camera": draws[:1], "the truth": truth.positions[None]}
standing = {name: some - [0, some[..., 1].min(), 0] for name, some in shown.items()}
play_skeletons(standing, skeleton, "animals.html", fps=prior.fps)

# %% [markdown]
# ## 5. A prior of these very animals
#
# All that was needed is in the tracks. The smallest networks learn something of them in a minute or
# two: first poses, frame by frame under four views, then a code for a whole second. In the first
# thousand steps hardly a bone turns: what is found is how bodies stand.

# %%
size = MotionVAESettings.tiny()
settings = TrainingSettings(steps=1500, batch=16, learning_rate=2e-3, ema=0.97)
given = (tracks[:-40], tracks[-40:], size, body)
poses = PoseTrainee(*given, distance=7.0)
train(poses, settings, "own/poses", progress=False)
codes = MotionVAETrainee(*given, poses.learnt("own/poses"), distance=7.0)
train(codes, replace(settings, steps=600), "own/vae", progress=False)
own = MotionVAE.load("own/vae")
new = own.sample(np.random.default_rng(2), 50)


def speed(motions):
    """Return the mean speed of joints about the root, metres per second."""
    return own.fps * np.linalg.norm(np.diff(motions - motions[..., :1, :], axis=-3), axis=-1).mean()


real = [speed(animal.retarget(skeleton).resample(own.fps).positions) for animal in animals]
print(f"new motions are {speed(new) / np.mean(real):.2f} as fast as the animals' own")
play_skeletons(
    {
        "of the prior that ships": drawn[:2],
        "of these animals": new[:2],
    },
    skeleton,
    "own.html",
    fps=own.fps,
)

# %% [markdown]
# ## Next
#
# The same from your own files, with networks of a size that is of use:
#
#     probmotion train motion-vae --tracks "videos/*.csv" --tracks-fps 30 --threshold 0.5 \
#         --skeleton quadruped21 --out runs/mine
#
# and `notebooks/ablations/motion_vae.py` for what every part of it is worth.

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
# # From 2D tracks of animals to new 3D motion
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/05_animals.ipynb)
#
# Few animals wear markers, but there are videos of them and detectors for their joints. A motion VAE (Sun et al.
# 2024, *Ponymation*) learns from such 2D tracks how a kind of body moves in 3D. It maximises the evidence lower
# bound with one latent code $z \sim \mathcal{N}(0, I)$ per second of motion,
#
# $$
# \mathcal{L} = \mathcal{L}_\text{reconstruction in 2D} + \lambda_{KL}\,
#   \mathrm{KL}\left( q(z \mid \text{track}) \,\Vert\, \mathcal{N}(0, I) \right).
# $$
#
# `animal-vae` comes with the package. It was trained on dogs and on synthetic quadrupeds that walk, trot, pace,
# canter and spin.
#
# On Colab, first run `%pip install git+https://github.com/probmotion/probmotion`.

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
from probmotion.models.vae.view_hypotheses import evaluate_hypotheses
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.plots.animation import animate_skeletons
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers import DVAEInference

prior = MotionVAE.load("animal-vae")
skeleton = prior.skeleton
print(skeleton.n_joints, "joints,", prior.frames, "frames at", prior.fps, "a second")

# %% [markdown]
# ## 1. Tracks
#
# Eight animals that the prior has not seen are filmed from all sides. For your own videos,
# `pm.read_keypoints` reads DeepLabCut tables and the JSON of other detectors.

# %%
animals = synthetic_animals(8, seed=3)
tracks = film_clips(animals, skeleton, prior.fps, views=40).tracks
print(len(tracks), "tracks of", tracks[0].frames, "frames")

# %% [markdown]
# The body is estimated from the tracks: over many views, the covariance of projected widths determines depth. No
# 3D data are used; the last line compares with the truth.

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
# A single view does not say whether a leg points towards the camera or away from it. The network makes four
# hypotheses, a quarter turn apart, and keeps the one that explains the tracks best within joint limits. Against
# the truth:

# %%
judged = evaluate_hypotheses(
    prior.model.pose, prior.settings, prior.body, animals, n=300, fps=prior.fps
)
print(
    f"the right view wins in {judged.right:.0%}, depth is not mirrored in {judged.depth_right:.0%}"
)
print(f"joints are {1000 * judged.error:.0f} mm from the truth")

# %% [markdown]
# ## 3. New motion
#
# One latent code is one second of motion. Draws stay in place, because the code does not contain the path.

# %%
drawn = prior.sample(np.random.default_rng(0), 6)
draw_skeletons({"draws": drawn[:4]}, skeleton, "animals.png", moments=5, azimuth=np.pi / 2)
Image("animals.png")

# %% [markdown]
# Longer motions join several codes by transition codes that are fitted to begin and end like their neighbours. At
# a seam a joint should accelerate no more than within the segments; `long_motion` warns otherwise.

# %%
codes = prior.initial(np.random.default_rng(1), 4)
pieces = prior.motion(codes)
long = long_motion(prior, codes)
within = max(greatest_acceleration(piece) for piece in pieces)
share = greatest_acceleration(long) / within
print(f"{len(long)} frames; the greatest acceleration is {share:.2f} of that within pieces")

# %%
animate_skeletons({"several codes": long[None]}, skeleton, "long.html", fps=prior.fps)

# %% [markdown]
# ## 4. One camera
#
# With keypoints as observations, the same prior gives a posterior. The pose network places the body; the encoder
# infers the code, and can be fitted to this recording.

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
animate_skeletons(standing, skeleton, "animals.html", fps=prior.fps)

# %% [markdown]
# ## 5. A prior of these animals
#
# Tiny networks learn from the tracks above in a minute or two: first poses, frame by frame under four view
# hypotheses, then a code for a whole second. In the first thousand steps hardly any bone rotates: the network
# first learns the standing pose.

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
animate_skeletons(
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
# The same from your own files, at a useful size:
#
#     probmotion train motion-vae --tracks "videos/*.csv" --tracks-fps 30 --threshold 0.5 \
#         --skeleton quadruped21 --out runs/mine
#
# `notebooks/ablations/motion_vae.py` measures what every part contributes.

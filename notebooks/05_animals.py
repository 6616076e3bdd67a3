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
# Motion capture of animals is rare, but there are videos of them and detectors for their joints. A motion VAE
# (variational autoencoder; Sun et al. 2024, *Ponymation*) learns from such 2D tracks how a kind of body moves in
# 3D. It maximises the evidence lower bound with one latent code $z \sim \mathcal{N}(0, I)$ per second of motion,
#
# $$
# \mathcal{L} = \mathcal{L}_\text{reconstruction in 2D} + \lambda_{KL}\,
#   \mathrm{KL}\left( q(z \mid \text{track}) \,\Vert\, \mathcal{N}(0, I) \right).
# $$
#
# The package includes the prior `animal-vae`, trained on dogs and on synthetic quadrupeds that walk, trot, pace,
# canter and spin.
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

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
print(f"{skeleton.n_joints} joints, {prior.frames} frames at {prior.fps:g} fps")

# %% [markdown]
# ## 1. Tracks
#
# Eight synthetic animals that are not in the training data are projected from all sides. For your own videos,
# `pm.read_keypoints` reads DeepLabCut tables and the JSON of other detectors.

# %%
animals = synthetic_animals(8, seed=3)
tracks = film_clips(animals, skeleton, prior.fps, views=40).tracks
print(len(tracks), "tracks of", tracks[0].frames, "frames")

# %% [markdown]
# The body is estimated from the tracks: over many views, the covariance of projected widths determines depth. No
# 3D data are used; the truth is needed only for the printed error.

# %%
body = ArticulatedBody(skeleton, estimate_rest_pose(tracks))
true_lengths = np.linalg.norm(
    [
        animals[0].positions[0, joint] - animals[0].positions[0, parent]
        for joint, parent in skeleton.bones
    ],
    axis=-1,
)
lengths = np.linalg.norm([body.rest[joint] for joint, _ in skeleton.bones], axis=-1)
print(f"mean error of bone lengths: {100 * np.abs(lengths / true_lengths - 1).mean():.1f} %")

# %% [markdown]
# ## 2. View hypotheses
#
# A single view does not show whether a leg points towards the camera or away from it. The network makes four
# hypotheses about the view, a quarter turn apart, and selects the one that fits the tracks best within joint
# limits. Comparison with the truth:

# %%
selection = evaluate_hypotheses(
    prior.model.pose, prior.settings, prior.body, animals, n=300, fps=prior.fps
)
print(
    f"correct view in {selection.right:.0%}, correct depth in {selection.depth_right:.0%} of sequences"
)
print(f"mean joint error: {1000 * selection.error:.0f} mm")

# %% [markdown]
# ## 3. New motion
#
# One latent code represents one second of motion. Draws stay at one position, because the code does not contain
# the path.

# %%
drawn = prior.sample(np.random.default_rng(0), 6)
draw_skeletons({"draws": drawn[:4]}, skeleton, "animals.png", moments=5, azimuth=np.pi / 2)
Image("animals.png")

# %% [markdown]
# Longer motions consist of several codes, joined by transition codes that are optimised to begin and end like
# their neighbours. At segment boundaries, the maximum acceleration should not exceed that within segments;
# `long_motion` warns otherwise.

# %%
codes = prior.initial(np.random.default_rng(1), 4)
segments = prior.motion(codes)
long = long_motion(prior, codes)
within = max(greatest_acceleration(segment) for segment in segments)
ratio = greatest_acceleration(long) / within
print(f"{len(long)} frames; maximum acceleration {ratio:.2f} times that within segments")

# %%
animate_skeletons({"several codes": long[None]}, skeleton, "long.html", fps=prior.fps)

# %% [markdown]
# ## 4. One camera
#
# With keypoints as observations, the same prior defines a posterior. The pose network estimates position and
# orientation of the body; the encoder infers the code, and can be optimised for this recording.

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
print(pd.DataFrame(rows).T.round(1).to_string())

# %%
shown = {"draws": drawn[:1], "seen by one camera": draws[:1], "the truth": truth.positions[None]}
standing = {name: some - [0, some[..., 1].min(), 0] for name, some in shown.items()}
animate_skeletons(standing, skeleton, "animals.html", fps=prior.fps)

# %% [markdown]
# ## 5. A prior trained on these animals
#
# Tiny networks are trained on the tracks above in a minute or two: first the pose network, frame by frame under
# four view hypotheses, then the VAE, with one code per second. In the first thousand steps, the network learns
# the standing pose and hardly any bone rotates.

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
print(f"speed of draws relative to the animals: {speed(new) / np.mean(real):.2f}")
animate_skeletons(
    {
        "shipped prior": drawn[:2],
        "prior trained on these animals": new[:2],
    },
    skeleton,
    "own.html",
    fps=own.fps,
)

# %% [markdown]
# ## Next
#
# To train a larger model on your own files:
#
#     probmotion train motion-vae --tracks "videos/*.csv" --tracks-fps 30 --threshold 0.5 \
#         --skeleton quadruped21 --out runs/mine
#
# `notebooks/ablations/motion_vae.py` measures the contribution of every component.

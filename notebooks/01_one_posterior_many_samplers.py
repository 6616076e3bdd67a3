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
# # One posterior, many samplers
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/01_one_posterior_many_samplers.ipynb)
#
# One camera observes a person, and the person's 3D motion is to be estimated. A single view does not determine
# depth, so the result is a *distribution* over motions, the posterior. A *sampler* is a method that draws motions
# from it.
#
# This notebook starts from BVH files and compares the errors of several samplers in a table. The prior is a
# Gaussian mixture, for which the posterior is known exactly:
#
# $$
# p(X \mid y) \propto p(X)\, p(y \mid X), \qquad
# p(X) = \sum_k w_k\, \mathcal{N}(X; \mu_k, W_k W_k^\top + \sigma^2 I).
# $$
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

# %%
from pathlib import Path

import numpy as np
from IPython.display import Image

import probmotion as pm
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.models import GaussianMixtureMotion
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers import (
    Ancestral3D,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
    SplitGibbs,
)

# %% [markdown]
# ## 1. Motion files
#
# Put your own BVH files into the folder `walks`. If there are none, synthetic clips of people who walk, run and
# march are written there.

# %%
folder = Path("walks")
if not list(folder.glob("*.bvh")):
    folder.mkdir(exist_ok=True)
    for clip in make_gaits(120, frames=32):
        pm.save(clip, folder / f"{clip.name}.bvh")

clips = pm.load_all(f"{folder}/*.bvh", fps=30)
print(f"{len(clips)} clips, the first: {clips[0]}")

# %% [markdown]
# A `Motion` is an array of joint positions in metres, with Y up, a skeleton and a frame rate.

# %%
draw_skeletons(
    {clip.name: clip.centred().positions[None] for clip in (clips[0], clips[40], clips[-1])},
    clips[0].skeleton,
    "clips.png",
    moments=8,
    heading=np.pi / 3,
)
Image("clips.png")

# %% [markdown]
# ## 2. The prior
#
# The last clip is held out and later observed by the camera. The prior is fitted to the other clips. It has three
# styles, each a Gaussian over whole motions of 30 frames, rotated about the vertical axis by any of 36 angles.

# %%
*training, held_out = clips
prior = GaussianMixtureMotion.fit(training, frames=30, rank=8, styles=3)
print(f"{len(prior.weights)} styles x {prior.azimuths} angles, {prior.rank} dimensions each")

draw_skeletons(
    {"draws from the prior": prior.sample(np.random.default_rng(0), 3)},
    prior.skeleton,
    "prior.png",
    heading=np.pi / 3,
)
Image("prior.png")

# %% [markdown]
# ## 3. The observations
#
# The camera is 15° above the horizon. It observes hips, shoulders and knees only, in every tenth frame, with
# errors of 3 cm. Most of the motion remains undetermined.

# %%
truth = held_out.window(0, 30).centred()
camera = pm.Cameras.ring(1, elevation=np.pi / 12)
occluded = np.ones(truth.positions.shape[:2], dtype=bool)
for part in ("hip", "shoulder", "knee"):
    for side in ("left", "right"):
        occluded[::10, truth.skeleton.index(f"{side}_{part}")] = False
keypoints = pm.Keypoints2D.observe(truth, camera, noise=0.03, seed=0, hidden=occluded)
posterior = pm.MotionPosterior(prior, keypoints)
print(f"{(~occluded).sum()} of {occluded.size} keypoints observed")

# %% [markdown]
# Prior and likelihood define the **posterior**, the object that every sampler receives. This posterior can be
# sampled exactly. The figure shows three exact draws from the side, where the depth is visible; the true motion
# is grey.

# %%
exact = prior.exact_posterior(keypoints).sample(np.random.default_rng(0), 3)
side = dict(azimuth=np.pi / 2, truth=truth.positions)
draw_skeletons({"exact": exact}, prior.skeleton, "posterior.png", **side)
Image("posterior.png")

# %% [markdown]
# All three draws agree with the observations, but differ from each other. A sampler must reproduce this spread.
#
# ## 4. Five samplers
#
# These samplers do not use the closed form. `ancestral3d` denoises a 3D motion step by step. `mas` (multi-view
# ancestral sampling) denoises five views at once with a 2D model. `mvpc` (multi-view predictor-corrector) adds a
# correction after every step. `split-gibbs` alternates between prior and observations, with the same 2D model and many
# more evaluations. `mh`, random-walk Metropolis-Hastings, requires only a density. All samplers have
# the same method `sample`:

# %%
draws = MultiViewAncestral(steps=50).sample(posterior, draws=20, seed=0, progress=False)
print(draws.positions.sizes)
pm.save(draws.motion(draw=3), "take3.bvh")

# %% [markdown]
# `compare` runs all samplers with the same metrics and stores every finished run in a folder, so that an
# interrupted comparison continues where it stopped.

# %%
comparison = pm.compare(
    {"one camera": posterior},
    {
        "exact": "exact",
        "ancestral3d": Ancestral3D(),
        "mas": MultiViewAncestral(steps=50),
        "mvpc": MultiViewPredictorCorrector(steps=51),
        "split-gibbs": SplitGibbs(denoiser="2d"),
        "mh": "mh",
    },
    draws=48,
    out="comparison",
    progress=False,
)
comparison.table()

# %% [markdown]
# ## 5. Errors of the samplers
#
# With $x$ the draws and $y$ exact draws of the same posterior,
#
# $$
# \text{swd ratio} = \frac{\mathrm{SW}(x, y)}{\mathrm{SW}(y, y')}, \qquad
# \text{variance ratio} = \frac{\mathrm{tr}\,\mathrm{Cov}[x]}{\mathrm{tr}\,\mathrm{Cov}[y]} .
# $$
#
# The first is the sliced Wasserstein distance to exact draws in units of the distance between two exact sets; at
# 1, the draws are indistinguishable from exact draws. A variance ratio below 1 is overconfident, above 1
# underconfident. `off_manifold_ratio` compares the variance that no style explains; below 1, motions are too
# smooth. The figure shows these errors and the cost:

# %%
comparison.plot("quality.png")
Image("quality.png")

# %% [markdown]
# - `ancestral3d` has the correct variance off the manifold, but draws the two styles in wrong proportions
#   (`mode_proportions_tv`): guidance finds motions that agree with the observations in each style, and does not know
#   how likely the observations are in it.
# - `mas` adds errors of single views: its variance is almost twice the correct one.
# - `mvpc` has a smaller error at the same number of denoiser evaluations, since its views cover the sphere.
# - `split-gibbs` is exact within a style, but does not change the style of its start: one of eight guided draws, weighted
#   by how likely the observations are. The proportions are closer than those of `ancestral3d`, and not yet right. Where
#   the observations leave one mode, as in the problem `gait-monocular`, it is right.
# - `mh` is as close as exact draws, but its chains have not converged (R-hat far above 1.01, few effective
#   draws). It also requires a log density, which a learnt 2D model does not have.
#
# The figure shows two draws per sampler, and the truth in grey:

# %%
draw_skeletons(
    {name: comparison.draws("one camera", name).flat()[:2] for name in ("exact", "mas", "mh")},
    prior.skeleton,
    "samplers.png",
    **side,
)
Image("samplers.png")

# %% [markdown]
# ## Next
#
# To compare all samplers on your own clips from the command line, run:
#
#     probmotion compare --clips "walks/*.bvh" --observe monocular --out mine --figures
#
# The documentation shows how to add your own sampler in twenty lines.

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
# # Denoising a recording, with uncertainty
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/04_denoising.ipynb)
#
# Triangulated joints have errors of centimetres, limbs are occluded, and some detections are outliers. A filter
# can only smooth the recorded joints. Motion-DVAE (Fiche et al. 2023) is a *prior* of body motion with one latent
# variable per frame,
#
# $$
# p(x_{1:L}, z_{1:L}) = \prod_t p(z_t \mid z_{t-1}, x_{<t})\; p(x_t \mid x_{<t}, z_t),
# $$
#
# together with networks that map noisy joints to an approximate posterior.
#
# Put your own recording (`.bvh` or `.npz` of 3D joints, floor at height 0) into the folder `recordings`; noise is
# added to it so that errors can be measured. Otherwise a held-out CMU clip is used if available, else a synthetic
# walk of a body that the prior has not seen.
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

# %%
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import Image

import probmotion as pm
from probmotion.data.cmu_clips import cmu_clip
from probmotion.data.joint_filters import filled_between, kalman_smooth, savitzky_golay
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.metrics import accuracy
from probmotion.plots.animation import animate_skeletons
from probmotion.plots.skeletons import draw_skeletons
from probmotion.posteriors.noisy_joints import noisy_joints
from probmotion.problems.denoising import body_of, body_prior, limb_occlusions
from probmotion.samplers import DVAEInference

prior = body_prior()
files = [*Path("recordings").glob("*.bvh"), *Path("recordings").glob("*.npz")]
if files:
    clip = pm.load_all(files[:1])[0]
else:
    try:
        clip = cmu_clip("cmu_02_02")
    except FileNotFoundError:
        clip = synthetic_walks(1, prior.skeleton, seconds=4)[0]
clip = clip.retarget(prior.skeleton).resample(prior.fps)
truth = clip.window(0, min(75, clip.frames))
print(truth)

# %% [markdown]
# ## 1. The recording
#
# The recording has Gaussian noise of 4 cm per coordinate. The right elbow and wrist are occluded for a third of
# the time, then the left knee and ankle.

# %%
occluded = limb_occlusions(truth)
recorded = pm.Joints3D.observe(truth, noise=0.04, seed=0, hidden=occluded)

# %% [markdown]
# Your own recording is an array (frames, joints, 3) with NaN for missing joints. `noisy_joints` converts it to a
# likelihood and raises an error for a wrong frame rate, unit or joint name.

# %%
array = np.where(occluded[..., None], np.nan, recorded.joints)
likelihood = noisy_joints(
    array, truth.skeleton, truth.fps, prior=prior.of(frames=truth.frames), noise=0.04
)
assert np.array_equal(likelihood.entries.visible, ~occluded)

# %% [markdown]
# ## 2. The posterior
#
# Bone lengths are estimated from the recording. Prior and likelihood then define a posterior like any other.

# %%
body = body_of(recorded, prior)
posterior = pm.MotionPosterior(prior.of(frames=truth.frames, body=body), recorded)
regression = DVAEInference()
draws = regression.sample(posterior, draws=100, seed=0, progress=False)
drawn = draws.flat()
print(f"{len(drawn)} draws in {float(draws.dataset.attrs['seconds']):.1f} s")

# %% [markdown]
# The networks were trained on other recordings. They can be used unchanged (`mode="regression"`) or optimised for
# this recording (`mode="optimization"`), which takes longer. `predict` returns a single estimate.

# %%
optimised = DVAEInference(mode="optimization")
joints = recorded.joints
visible = ~occluded
kalman, _ = kalman_smooth(joints, visible.astype(float), noise=0.04, fps=truth.fps)
estimates = {
    "recorded, interpolated": filled_between(joints, visible),
    "Savitzky-Golay filter": savitzky_golay(joints, visible, fps=truth.fps),
    "Kalman smoother": kalman,
    "Motion-DVAE, regression": regression.predict(posterior, progress=False).positions,
    "Motion-DVAE, optimization": optimised.predict(posterior, progress=False).positions,
    "Motion-DVAE, mean of the draws": drawn.mean(axis=0),
}
rows = {}
for name, positions in estimates.items():
    errors = 1000 * accuracy.joint_errors(positions, truth.positions)
    rows[name] = {
        "all, mm": errors.mean(),
        "visible, mm": errors[visible].mean(),
        "occluded, mm": errors[occluded].mean(),
        "acceleration": float(accuracy.acceleration_ratio(positions, truth.positions)),
    }
print(pd.DataFrame(rows).T.round(2).to_string())

# %% [markdown]
# The first three columns are mean joint errors. The last column is the acceleration relative to the truth: 1 is
# ideal, above 2 the motion jitters, below 0.5 it is oversmoothed.
#
# ## 3. Calibration of the uncertainty
#
# Draws should differ most where joints are occluded. If the posterior is calibrated, its spread equals its error
# and 90 % of coordinates lie in the central 90 % interval. The variational approximation is overconfident, more
# so for a body that is not in the training data; optimisation reduces the overconfidence:

# %%
fitted = optimised.sample(posterior, draws=100, seed=0, progress=False).flat()
rows = {}
for name, motions in (("regression", drawn), ("optimization", fitted)):
    middle = motions.mean(axis=0)
    spread = 1000 * np.sqrt(((motions - middle) ** 2).sum(axis=-1).mean(axis=0))
    error = 1000 * np.linalg.norm(middle - truth.positions, axis=-1)
    low, high = np.quantile(motions, [0.05, 0.95], axis=0)
    inside = (truth.positions >= low) & (truth.positions <= high)
    for kind, mask in (("visible", visible), ("occluded", occluded)):
        rows[f"{name}, {kind}"] = {
            "spread, mm": spread[mask].mean(),
            "error, mm": error[mask].mean(),
            "truth inside the central 90 %": inside[mask].mean(),
        }
print(pd.DataFrame(rows).T.round(2).to_string())

# %%
some = slice(None, None, 8)
draw_skeletons(
    {
        "recorded": estimates["recorded, interpolated"][None, some],
        "Kalman": kalman[None, some],
        "a draw": fitted[:1, some],
    },
    truth.skeleton,
    "denoised.png",
    moments=9,
    truth=truth.positions[some],
)
Image("denoised.png")

# %% [markdown]
# The animation shows the estimates side by side. Drag it to rotate.

# %%
animate_skeletons(
    {
        "recorded": estimates["recorded, interpolated"][None],
        "Kalman": kalman[None],
        "a draw": fitted[:1],
        "the truth": truth.positions[None],
    },
    truth.skeleton,
    "denoised.html",
    fps=truth.fps,
)

# %% [markdown]
# ## Next
#
# To compare other samplers on the command line:
#
#     probmotion compare denoise-cmu denoise-cmu-occluded --samplers dvae nuts --draws 200
#
# To train a prior and a denoiser on your own clips:
#
#     probmotion train dvae --clips "clips/*.bvh" --out body
#     probmotion train denoiser --prior body --clips "clips/*.bvh" --out denoiser

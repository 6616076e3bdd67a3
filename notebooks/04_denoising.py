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
# # A noisy recording in, a motion and its uncertainty out
#
# Cameras that triangulate joints err by centimetres, lose limbs behind furniture, and now and
# then see a hand where there is none. A filter smooths what it was given. A *prior* knows how
# bodies move: Motion-DVAE (Fiche et al. 2023) learnt from motion capture what a body does next,
# and networks that read noisy joints answer with a distribution over motions, at once.
#
# Put a recording of your own, a `.bvh` or `.npz` of 3D joints with the floor at height 0, into the
# folder `recordings`; noise is put on it, so that errors can be told. Without one, a CMU clip is
# taken that the prior has not learnt from, where it is at hand; else a body that the project makes
# walks, as no body that was learnt from.

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
from probmotion.plots.animation import play_skeletons
from probmotion.plots.skeletons import draw_skeletons
from probmotion.posteriors.noisy_joints import noisy_joints
from probmotion.problems.denoising import body_of, body_prior, limbs_hidden
from probmotion.samplers import DVAEInference

prior = body_prior()
files = [*Path("recordings").glob("*.bvh"), *Path("recordings").glob("*.npz")]
if files:
    clip = pm.load_motions(files[:1])[0]
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
# Every joint is off by 4 cm in each direction. The right elbow and wrist hide for a third of the
# time, then the left knee and ankle.

# %%
hidden = limbs_hidden(truth)
recorded = pm.Joints3D.observe(truth, noise=0.04, seed=0, hidden=hidden)

# %% [markdown]
# A recording from elsewhere is an array of joints (frames, joints, 3) with NaN where nothing was
# seen. `noisy_joints` makes evidence of it, and says in a sentence what does not fit: another
# frame rate, millimetres, joints that the prior does not know.

# %%
array = np.where(hidden[..., None], np.nan, recorded.joints)
same = noisy_joints(
    array, truth.skeleton, truth.fps, prior=prior.of(frames=truth.frames), noise=0.04
)
assert np.array_equal(same.entries.visible, ~hidden)

# %% [markdown]
# ## 2. The posterior
#
# How long this body's bones are is estimated from the recording. Then prior and evidence make a
# posterior like any other, of which a sampler draws.

# %%
body = body_of(recorded, prior)
posterior = pm.MotionPosterior(prior.of(frames=truth.frames, body=body), recorded)
regression = DVAEInference()
draws = regression.sample(posterior, draws=100, seed=0, progress=False)
drawn = draws.flat()
print(f"{len(drawn)} draws in {float(draws.dataset.attrs['seconds']):.1f} s")

# %% [markdown]
# The networks learnt from other recordings (`mode="regression"`); they may also be fitted to this
# one (`mode="optimization"`), which takes longer. `predict` gives one motion, between what was
# observed and what is believed.

# %%
fit = DVAEInference(mode="optimization")
joints = recorded.joints
seen = ~hidden
kalman, _ = kalman_smooth(joints, seen.astype(float), noise=0.04, fps=truth.fps)
estimates = {
    "recorded, hidden ones interpolated": filled_between(joints, seen),
    "Savitzky-Golay filter": savitzky_golay(joints, seen, fps=truth.fps),
    "Kalman smoother": kalman,
    "Motion-DVAE, regression": regression.predict(posterior, progress=False).positions,
    "Motion-DVAE, optimization": fit.predict(posterior, progress=False).positions,
    "Motion-DVAE, mean of the draws": drawn.mean(axis=0),
}
rows = {}
for name, found in estimates.items():
    errors = 1000 * accuracy.joint_errors(found, truth.positions)
    rows[name] = {
        "all, mm": errors.mean(),
        "seen, mm": errors[seen].mean(),
        "hidden, mm": errors[hidden].mean(),
        "acceleration": float(accuracy.acceleration_ratio(found, truth.positions)),
    }
print(pd.DataFrame(rows).T.round(2).to_string())

# %% [markdown]
# The last column is how much a motion accelerates against the truth: 1 is right, above 2 it
# jitters, below a half it is smeared.
#
# ## 3. How sure is it?
#
# Draws differ where the recording does not say: hidden joints. An honest posterior's spread is as
# large as its errors, and nine of ten coordinates lie inside its central 90 %. Those of a
# variational approximation are too narrow, and of a body that the prior does not know, the more so:
# the table below says by how much, and fitting helps.

# %%
fitted = fit.sample(posterior, draws=100, seed=0, progress=False).flat()
rows = {}
for name, motions in (("regression", drawn), ("optimization", fitted)):
    middle = motions.mean(axis=0)
    spread = 1000 * np.sqrt(((motions - middle) ** 2).sum(axis=-1).mean(axis=0))
    error = 1000 * np.linalg.norm(middle - truth.positions, axis=-1)
    low, high = np.quantile(motions, [0.05, 0.95], axis=0)
    inside = (truth.positions >= low) & (truth.positions <= high)
    for joints_are, which in (("seen", seen), ("hidden", hidden)):
        rows[f"{name}, {joints_are}"] = {
            "spread, mm": spread[which].mean(),
            "error, mm": error[which].mean(),
            "truth inside the central 90 %": inside[which].mean(),
        }
print(pd.DataFrame(rows).T.round(2).to_string())

# %%
some = slice(None, None, 8)
draw_skeletons(
    {
        "recorded": estimates["recorded, hidden ones interpolated"][None, some],
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
# Side by side, in motion. Drag them to look from elsewhere.

# %%
play_skeletons(
    {
        "recorded": estimates["recorded, hidden ones interpolated"][None],
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
# The same question as a comparison with other samplers, and from the command line:
#
#     probmotion compare denoise-cmu denoise-cmu-occluded --samplers dvae nuts --draws 200
#
# A prior and a denoiser of your own clips:
#
#     probmotion train dvae --clips "clips/*.bvh" --out body
#     probmotion train denoiser --prior body --clips "clips/*.bvh" --out denoiser

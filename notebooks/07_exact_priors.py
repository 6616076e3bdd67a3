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
# # What a Gaussian can do
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/07_exact_priors.ipynb)
#
# A *spectral mixture* is a prior of motion without a network: over time, the joints of each component are
# independent Gaussian frequencies, with a covariance over joints at every frequency. Spatial covariance tells where a
# hidden limb is, and the spectrum how it may move. Density, denoisers and posterior are exact, so that samplers can be
# compared with the truth *on real motion*, and a recording is denoised in milliseconds per frame.
#
# Where does it fail? Section 3 measures that on motion unlike the training clips.
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

# %%
import os
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import probmotion as pm
from probmotion.data.cmu_clips import cmu_clip
from probmotion.data.joint_filters import kalman_smooth
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.models import SpectralMixtureMotion
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.plots.animation import animate_skeletons
from probmotion.problems.denoising import limb_occlusions

prior = SpectralMixtureMotion.load("cmu-motion")
print(f"{len(prior.weights)} components at {len(prior.scales)} scales, {prior.frames} frames")

# %% [markdown]
# ## 1. Draws of the prior
#
# Draws are independent and take no iterations, but they are distorted people: bones differ in length, and bodies
# float or lean. A Gaussian knows only means and covariances. It is a prior to *infer* with, from observations that fix
# what it does not know; for generation, see tutorial 3.

# %%
started = time.perf_counter()
motions = prior.sample(np.random.default_rng(0), 100)
print(f"100 motions of 2 s: {time.perf_counter() - started:.2f} s")
thigh = np.linalg.norm(
    motions[:, :, prior.skeleton.index("left_knee")]
    - motions[:, :, prior.skeleton.index("left_hip")],
    axis=-1,
)
print(f"thigh: {thigh.mean():.2f} m; within a motion it varies by {thigh.std(axis=1).mean():.3f} m")
animate_skeletons({"draws of cmu-motion": motions[:4]}, prior.skeleton, fps=prior.fps)

# %% [markdown]
# ## 2. A recording with noise and a hidden limb
#
# The truth is a held-out walk (CMU, else synthetic). Noise is 4 cm per coordinate; an arm and then a leg are hidden for
# a third of the time each.

# %%
try:
    clip = cmu_clip("cmu_02_02").retarget(prior.skeleton).resample(prior.fps)
except FileNotFoundError:
    clip = synthetic_walks(1, prior.skeleton, seconds=2.5)[0].retarget(prior.skeleton)


def denoised(clip, noise=0.04, seed=0):
    """Return errors in mm and coverage of 90 % intervals: (seen, hidden) each."""
    hidden = limb_occlusions(clip)
    rng = np.random.default_rng(seed)
    joints = clip.positions + noise * rng.standard_normal(clip.positions.shape)
    joints[hidden] = np.nan
    started = time.perf_counter()
    found = denoise_joints(
        joints, skeleton=clip.skeleton, fps=clip.fps, noise=noise, draws=20, progress=False
    )
    seconds = time.perf_counter() - started
    smooth, _ = kalman_smooth(joints, (~hidden).astype(float), noise=noise, fps=clip.fps)
    covered = np.abs(found.mean - clip.positions) < 1.645 * found.sd
    row = {}
    for name, mask in (("seen", ~hidden), ("hidden", hidden)):
        error = [
            np.linalg.norm(x - clip.positions, axis=-1)[mask].mean() for x in (found.mean, smooth)
        ]
        row |= {f"{name}, mm": 1000 * error[0], f"{name}, smoother, mm": 1000 * error[1]}
        row[f"{name}, in 90 % interval"] = covered[mask].mean()
    return found, row | {"ms per frame": 1000 * seconds / clip.frames}


found, row = denoised(clip)
pd.Series(row).round(2).to_frame(clip.name or "walk")

# %% [markdown]
# The draws continue the motion of hidden joints in different ways; their spread is the uncertainty.

# %%
wrist = prior.skeleton.index("right_wrist")
times = np.arange(clip.frames) / clip.fps
hidden = times[limb_occlusions(clip)[:, wrist]]
fig, ax = plt.subplots(figsize=(7, 3))
ax.axvspan(hidden[0], hidden[-1], color="0.92", label="hidden")
lines = ax.plot(times, found.draws[:, :, wrist, 1].T, color="tab:orange", alpha=0.5, linewidth=0.8)
lines[0].set_label("20 draws")
ax.plot(times, clip.positions[:, wrist, 1], color="black", label="truth")
ax.set(xlabel="time (s)", ylabel="height of the right wrist (m)")
ax.legend(frameon=False)
fig.tight_layout()

# %% [markdown]
# ## 3. Where it fails
#
# The shipped prior was learnt without soccer and without getting up from the back. In these two recordings, it finds
# hidden joints no better than a Kalman smoother, which knows nothing about bodies: their errors are large.

# %%
data = Path(os.environ.get("PROBMOTION_DATA", "../shared/data"))
rows = {"walk (held out)": row}
for name, path in (
    ("soccer (action kept out)", data / "cmu_actions" / "soccer_1.npz"),
    ("getting up (kept out)", data / "deepmimic_human" / "humanoid3d_getup_faceup.npz"),
):
    if path.is_file():
        unlike = pm.load(path).retarget(prior.skeleton).resample(prior.fps)
        rows[name] = denoised(unlike.window(0, min(unlike.frames, 120)))[1]
pd.DataFrame(rows).round(2)

# %% [markdown]
# ## 4. A problem with an exact answer
#
# The prior is a prior like any other: every sampler runs on it, and its error is known.

# %%
problem = pm.problem("cmu-motion")
draws = pm.sample(problem, "exact", draws=400, seed=0)
print(pm.score(problem, draws))

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
# # One posterior, many samplers
#
# A camera films a person. What did the person do in three dimensions? One picture is not enough
# to say: the depth is missing. The honest answer is a *distribution* over motions, and a method
# that answers is a *sampler* of it.
#
# This notebook goes from a BVH file to a table that says how far several samplers are from the
# right distribution. That can be said because the belief used here, a Gaussian mixture, is one for
# which the right distribution is known exactly.

# %%
from pathlib import Path

import numpy as np
from IPython.display import Image

import probmotion as pm
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.io.files import save_motion
from probmotion.models import GaussianMixtureMotion
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers import Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector

# %% [markdown]
# ## 1. Motion files
#
# Put BVH files of your own into the folder `walks`. If there is none, a few people who walk, run
# and march are made and written there.

# %%
folder = Path("walks")
if not list(folder.glob("*.bvh")):
    folder.mkdir(exist_ok=True)
    for clip in make_gaits(120, frames=32):
        save_motion(clip, folder / f"{clip.name}.bvh")

clips = pm.load_motions(f"{folder}/*.bvh", fps=30)
print(f"{len(clips)} clips, the first: {clips[0]}")

# %% [markdown]
# A `Motion` is an array of joint positions in metres, the world's Y axis up, with the skeleton's
# joint names and the frame rate. Nothing more is needed to look at it.

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
# ## 2. A belief: the prior
#
# One clip is put aside; it plays the person in front of the camera. To all others we fit a prior:
# three styles, each a Gaussian over whole motions of 30 frames, turned about the vertical by any
# of 36 angles. A draw from it is a new motion.

# %%
*seen, hidden = clips
prior = GaussianMixtureMotion.fit(seen, frames=30, rank=8, styles=3)
print(f"{len(prior.weights)} styles x {prior.azimuths} angles, {prior.rank} dimensions each")

draw_skeletons(
    {"draws from the prior": prior.sample(np.random.default_rng(0), 3)},
    prior.skeleton,
    "prior.png",
    heading=np.pi / 3,
)
Image("prior.png")

# %% [markdown]
# ## 3. Evidence: what one camera saw
#
# The camera stands 15° above the horizon. A detector reports each joint's place in the picture with
# an error of 3 cm, but of hips, shoulders and knees only, and only in every tenth frame. So a lot
# is left open.

# %%
truth = hidden.window(0, 30).centred()
camera = pm.Cameras.ring(1, elevation=np.pi / 12)
unseen = np.ones(truth.positions.shape[:2], dtype=bool)
for part in ("hip", "shoulder", "knee"):
    for side in ("left", "right"):
        unseen[::10, truth.skeleton.index(f"{side}_{part}")] = False
evidence = pm.Keypoints2D.observe(truth, camera, noise=0.03, seed=0, hidden=unseen)
posterior = pm.MotionPosterior(prior, evidence)
print(f"{(~unseen).sum()} keypoints seen of {unseen.size}")

# %% [markdown]
# Prior and evidence make the **posterior**: the one object that every sampler is given. Here it
# can also be drawn from exactly. Below are exact draws, seen from the side of the camera, which is
# the direction that the camera cannot see; the truth stands behind them in grey.

# %%
exact = prior.exact_posterior(evidence).sample(np.random.default_rng(0), 3)
side = dict(azimuth=np.pi / 2, truth=truth.positions)
draw_skeletons({"exact": exact}, prior.skeleton, "posterior.png", **side)
Image("posterior.png")

# %% [markdown]
# All three agree with what was seen, yet they differ: that spread is the uncertainty that an honest
# answer has to show.
#
# ## 4. Four samplers
#
# They know nothing of the closed form. `ancestral3d` removes noise from a 3D motion step by step;
# `mas` (multi-view ancestral sampling) does it with nothing but a 2D model, in five views at once;
# `mvpc` is `mas` with a correction after every step; `mh`, Metropolis and Hastings' random walk,
# needs a density only. All have the same one verb:

# %%
draws = MultiViewAncestral(steps=50).sample(posterior, draws=20, seed=0, progress=False)
print(draws.positions.sizes)
save_motion(draws.motion(draw=3), "take3.bvh")

# %% [markdown]
# `compare` runs them all under the same clock, with the same measures, and keeps every finished run
# in a folder, so that an interrupted comparison goes on where it stopped.

# %%
comparison = pm.compare(
    {"one camera": posterior},
    {
        "exact": "exact",
        "ancestral3d": Ancestral3D(steps=50),
        "mas": MultiViewAncestral(steps=50),
        "mvpc": MultiViewPredictorCorrector(steps=25),
        "mh": "mh",
    },
    draws=48,
    out="comparison",
    progress=False,
)
comparison.table()

# %% [markdown]
# ## 5. What is wrong with each
#
# `swd_ratio` is the distance from the exact posterior in units of the distance between two sets of
# exact draws: at 1 the two cannot be told apart. `variance_ratio` compares the spread: below 1 a
# sampler is overconfident, above 1 underconfident. `off_manifold_ratio` compares the part that no
# style explains: below 1 the
# motions are too smooth. Read them together with the cost: that is the picture to look at first.

# %%
comparison.plot("quality.png")
Image("quality.png")

# %% [markdown]
# - `ancestral3d` finds the right region, but its motions are too smooth: with 50 steps the
#   smallest variance is never reached (`off_manifold_ratio` far below 1). More steps mend that.
# - `mas` spreads about twice too wide. It corrects each of its views on its own, so that what the
#   camera saw reaches the others weakened.
# - `mvpc` is nearer at the same number of denoiser evaluations, and still too wide.
# - `mh` is as near as exact draws are, but its chains have not settled (`R-hat` far above 1.01,
#   and few effective draws, `ESS`). And it needs a log density, which a learnt 2D model does
#   not have: that is when the three above are for.
#
# The draws themselves tell the same. Here are two of each, the truth in grey.

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
# The same on your own clips, with all samplers, from the command line:
#
#     probmotion compare --clips "walks/*.bvh" --observe monocular --out mine --pictures
#
# A sampler of your own needs a name, a list of what it asks of a prior, and `sample`; the README
# has one in twenty lines.

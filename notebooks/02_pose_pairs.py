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
# # Two people who dance: 3D pose-pairs from 2D annotations
#
# Videos of two people in close contact are easy to come by; 3D recordings are not, as each body
# hides the other. Yin et al. (2018) never lift a picture to 3D. They build *one* posterior over
# pose-pairs from all annotated pictures of a kind of motion, and walk through it from a single
# 3D pose-pair, the seed. What comes out are new pose-pairs in space.
#
# This notebook goes from a dance clip to draws that can be played.

# %%
from pathlib import Path

import numpy as np
from IPython.display import Image

from probmotion.data.pair_sets import choose_seed, dance_frames, describe_dance_frames, ground_truth
from probmotion.data.pairs import load_pairs
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.retrieval import retrieve
from probmotion.io.files import save_motion
from probmotion.metrics.coverage import coverage
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.plots.calibration_curves import draw_calibration
from probmotion.plots.pairs import draw_pairs
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic

# %% [markdown]
# ## 1. A dance
#
# Put `.npz` clips of two people into the folder `dances` (for two BVH files with a common frame
# there is `probmotion.data.pairs.pair_motion`, for keypoint JSON of a video
# `annotations_of_tracks`). If there is none, a few dances are made and written there.

# %%
folder = Path("dances")
if not list(folder.glob("*.npz")):
    folder.mkdir(exist_ok=True)
    for clip in synthetic_dances(6):
        save_motion(clip, folder / f"{clip.name}.npz")

*shown, hidden = load_pairs(sorted(folder.glob("*.npz")))
print(describe_dance_frames(shown[0]))
skeleton = shown[0].skeleton

real, _, _ = ground_truth([hidden], 6)
draw_pairs({"held out": real}, skeleton, "real.png", azimuth=0.6, elevation=0.2)
Image("real.png")

# %% [markdown]
# The last clip is held out, whole: neighbouring frames of one clip are nearly the same pose, and
# would tell what the draws are to find.
#
# ## 2. Annotations, and one seed
#
# Frames of the other clips are drawn in 2D, each from a camera somewhere around the dancers. Nobody
# says where the camera stood: that is estimated from the torsos. The seed is the frame that is
# most like all others.

# %%
drawn = draw_annotations(shown, 200, seed=0, frames=[dance_frames(clip) for clip in shown])
poses, _, _ = ground_truth(shown)
seed = poses[choose_seed(poses)]
print(drawn.annotations.describe())

draw_pairs(
    {"annotations": drawn.annotations.keypoints, "the seed": seed[None]},
    skeleton,
    "annotations.png",
)
Image("annotations.png")

# %% [markdown]
# ## 3. The posterior
#
# The prior says what bodies can do (joint limits learnt from motion capture, no limb through
# another). The likelihood says that, seen from where cameras stand, the pair looks like some
# annotation: compared in *interaction coordinates*, the edges of a triangulation of all joints of
# both people, which hold the poses and what lies between them. A state has 108 numbers.

# %%
posterior = pair_posterior(seed, drawn.annotations, PairSettings(n_views=16, n_near=16))
print(f"{posterior.dim} dimensions; log density of the seed {posterior.log_seed:.1f} nats")

# %% [markdown]
# ## 4. Draws
#
# `mh` walks. Four chains, all from the seed; the warm-up finds the size of the steps.

# %%
sampler = MetropolisHastings(Isotropic(0.02), warmup=1500, thin=20)
draws = sampler.sample(posterior, draws=150, chains=4, seed=0, progress=False)
print(f"accepted: {float(draws.dataset['acceptance'].mean()):.2f}")

drawn_poses = draws.flat()[:, 0]
shown_poses = align_rigidly(drawn_poses[::100], np.broadcast_to(seed, (6, *seed.shape)))
draw_pairs({"draws": shown_poses}, skeleton, "draws.png", azimuth=0.6, elevation=0.2)
Image("draws.png")

# %% [markdown]
# Where the pair stands and which way is up is nothing that a picture tells: to be looked at, draws
# are turned to the seed.
#
# Is the density one that real pairs could be drawn from? Before anything is believed, look at what
# it says of real pairs, of the seed and of its own draws.

# %%
levels = {}
for kind, some in {"real pairs": poses[::5], "draws": drawn_poses, "seed": seed[None]}.items():
    levels[kind] = {
        "log prior": posterior.prior.log_plausibility(some[:, None]),
        "log likelihood": posterior.likelihood.log_density(some[:, None]),
    }
draw_calibration(levels, "calibration.png")
Image("calibration.png")

# %% [markdown]
# All three should overlap. Here draws are likelier than most real pairs: each chain has settled
# where one annotation, seen from one side, is matched well, and moves on slowly.
#
# ## 5. What are the draws like?
#
# For some draws, the annotation that is nearest to one of their views.

# %%
some = drawn_poses[:: len(drawn_poses) // 5][:5]
pictures = project_to_views(some, posterior.likelihood.views, skeleton)
distances, closest = posterior.likelihood.comparer.nearest(pictures, posterior.likelihood.near)
best = distances.argmin(axis=1)
rows = np.arange(len(some))
draw_pairs(
    {
        "draws, seen\nfrom a view": pictures[rows, best],
        "nearest\nannotation": drawn.annotations.keypoints[closest[rows, best]],
    },
    skeleton,
    "nearest.png",
    columns=5,
)
Image("nearest.png")

# %% [markdown]
# The other way round, *indirect lifting*: which draw looks most like a picture that nobody has
# annotated? And how well do the draws cover the clip that was held out?

# %%
asked = draw_annotations([hidden], 1, seed=1)
found = retrieve(asked.annotations.keypoints[0], drawn_poses, skeleton)
print(f"nearest draw: {int(found.indices[0])}, {float(found.distances[0]):.3f} m away in 2D")

truth, _, _ = ground_truth([hidden], 60)
print(f"coverage: {coverage(truth, drawn_poses):.3f} m, by the seed alone "
      f"{coverage(truth, seed[None]):.3f} m")  # fmt: skip

# %% [markdown]
# ## 6. Play, and go on from where you like
#
# A chain's draws, one after the other, are a motion: open it in Blender. Any draw can be where
# another run starts.

# %%
save_motion(draws.playback(chain=0), "walk.bvh")
liked = draws.dataset["theta"].values[:1, 120]
again = sampler.sample(posterior, draws=5, chains=1, seed=1, initial=liked, progress=False)
print(again.positions.sizes)

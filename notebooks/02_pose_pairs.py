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
# # Two dancers: 3D pose pairs from 2D annotations
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/02_pose_pairs.ipynb)
#
# Videos of two people in close contact are common; 3D recordings are not, because each body occludes the other.
# Yin et al. (2018) do not lift single images to 3D. They define *one* posterior over pose pairs, given all
# annotated frames of a kind of motion, and sample it by Markov chain Monte Carlo (MCMC), starting at a single 3D
# pose pair, the seed:
#
# $$
# p(x \mid \mathcal{A}) \propto p(x) \frac{1}{m} \sum_{i=1}^{m} \max_{a \in \mathcal{A}}
#   \exp\!\left( - \frac{d_{IC}(P_{v_i} x, a)^2}{2 \sigma_l^2} \right),
# $$
#
# with the prior $p(x)$ of physically possible poses, annotations $a$, views $v_i$ and the distance $d_{IC}$ in
# interaction coordinates.
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

# %%
from pathlib import Path

import numpy as np
from IPython.display import Image

import probmotion as pm
from probmotion.data.pair_sets import choose_seed, dance_frames, describe_dance_frames, ground_truth
from probmotion.data.pairs import load_pairs
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.interaction.retrieval import retrieve
from probmotion.metrics.coverage import coverage
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.plots.calibration_curves import draw_calibration
from probmotion.plots.pairs import draw_pairs
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic

# %% [markdown]
# ## 1. A dance
#
# Put `.npz` clips of two people into the folder `dances` (`probmotion.data.pairs.pair_motion` joins two BVH
# files, `annotations_of_tracks` reads keypoint JSON of a video). If there are none, synthetic dances are written
# there.

# %%
folder = Path("dances")
if not list(folder.glob("*.npz")):
    folder.mkdir(exist_ok=True)
    for clip in synthetic_dances(6):
        pm.save(clip, folder / f"{clip.name}.npz")

*training, held_out = load_pairs(sorted(folder.glob("*.npz")))
print(describe_dance_frames(training[0]))
skeleton = training[0].skeleton

real, _, _ = ground_truth([held_out], 6)
draw_pairs({"held out": real}, skeleton, "real.png", azimuth=0.6, elevation=0.2)
Image("real.png")

# %% [markdown]
# The entire last clip is held out, because neighbouring frames of one clip show nearly the same pose.
#
# ## 2. Annotations and the seed
#
# Frames of the other clips are annotated in 2D, each from a random camera. The camera is unknown to the method,
# which estimates the view from the torsos. The seed is the frame that is most similar to all others.

# %%
drawn = draw_annotations(training, 200, seed=0, frames=[dance_frames(clip) for clip in training])
poses, _, _ = ground_truth(training)
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
# The prior contains joint limits learnt from motion capture and forbids limbs that penetrate each other. The
# likelihood compares projections of the pair with annotations in *interaction coordinates*: the edges of a
# Delaunay triangulation of all joints of both people, which describe the poses and the space between them. The
# state has 108 dimensions.

# %%
posterior = pair_posterior(seed, drawn.annotations, PairSettings(n_views=16, n_near=16))
print(f"{posterior.dim} dimensions; log density of the seed {posterior.log_seed:.1f} nats")

# %% [markdown]
# ## 4. Draws
#
# Four Metropolis-Hastings chains start at the seed; warm-up adapts the step size.

# %%
sampler = MetropolisHastings(Isotropic(0.02), warmup=1500, thin=20)
draws = sampler.sample(posterior, draws=150, chains=4, seed=0, progress=False)
print(f"accepted: {float(draws.dataset['acceptance_rate'].mean()):.2f}")

drawn_poses = draws.flat()[:, 0]
shown_poses = align_rigidly(drawn_poses[::100], np.broadcast_to(seed, (6, *seed.shape)))
draw_pairs({"draws": shown_poses}, skeleton, "draws.png", azimuth=0.6, elevation=0.2)
Image("draws.png")

# %% [markdown]
# The likelihood determines neither the position of the pair nor its orientation in the world. For the figure,
# draws are aligned to the seed.
#
# The next figure compares the log densities of real pairs, of the seed and of the draws:

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
# The three distributions should overlap. Here, draws have a higher density than most real pairs: each chain stays
# close to one annotation in one view and mixes slowly.
#
# ## 5. Comparison with annotations
#
# The figure shows projections of five draws, each with the nearest annotation:

# %%
some = drawn_poses[:: len(drawn_poses) // 5][:5]
projected = project_to_views(some, posterior.likelihood.views, skeleton)
distances, closest = posterior.likelihood.comparer.nearest(projected, posterior.likelihood.near)
best = distances.argmin(axis=1)
rows = np.arange(len(some))
draw_pairs(
    {
        "draws, seen\nfrom a view": projected[rows, best],
        "nearest\nannotation": drawn.annotations.keypoints[closest[rows, best]],
    },
    skeleton,
    "nearest.png",
    columns=5,
)
Image("nearest.png")

# %% [markdown]
# *Indirect lifting* retrieves the draw that is most similar to a 2D pair outside the annotations. The coverage is
# the mean distance between held-out poses and the nearest draw:

# %%
query = draw_annotations([held_out], 1, seed=1)
result = retrieve(query.annotations.keypoints[0], drawn_poses, skeleton)
print(f"nearest draw: {int(result.indices[0])}, {float(result.distances[0]):.3f} m away in 2D")

truth, _, _ = ground_truth([held_out], 60)
print(f"coverage: {coverage(truth, drawn_poses):.3f} m, by the seed alone "
      f"{coverage(truth, seed[None]):.3f} m")  # fmt: skip

# %% [markdown]
# ## 6. Animation of the draws, and continuation from one of them
#
# The draws of a chain, in order, form a motion that can be opened in Blender. Any draw can be the starting point
# of another run.

# %%
pm.save(draws.playback(chain=0), "walk.bvh")
start = draws.dataset["theta"].values[:1, 120]
continued = sampler.sample(posterior, draws=5, chains=1, seed=1, initial=start, progress=False)
print(continued.positions.sizes)

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
# # 3D motion from 2D data alone
#
# Videos are everywhere, 3D recordings are not. Kapon et al. (2024) learn a diffusion model of what
# motion looks like in *one* picture, from 2D tracks that nobody has lifted. Then they denoise
# several views of one motion together, and what comes out is in 3D: multi-view ancestral sampling,
# `mas`.
#
# This notebook goes from tracks to 3D motions that play, and measures them. All networks are tiny,
# so that it takes two minutes on one core; `notebooks/ablations/mas.py` is the same study in large.

# %%
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import Image

import probmotion as pm
from probmotion.data.projections import DetectorNoise, centre_motion, project_clips
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.data.tracks.learning import film_clips, film_windows, read_tracks, split_tracks
from probmotion.metrics.generation import GenerationReference
from probmotion.models.diffusion.motion_diffusion import DiffusionSettings, MotionDiffusion
from probmotion.models.diffusion.track_denoising import denoise_track
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
from probmotion.models.training.trainer import TrainingSettings, train
from probmotion.motion.distances import mirrored_fraction, nearest_distances, windows
from probmotion.plots.animation import play_skeletons
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers import MultiViewAncestral
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D

# %% [markdown]
# ## 1. Tracks
#
# Put keypoint files of your own (COCO, OpenPose or AlphaPose JSON, DeepLabCut, npz) into the
# folder `tracks`. If there is none, people who walk are made, cameras are placed around them at
# random, and a detector that errs finds their joints: only that is learnt from. Either way a
# preparation follows, which says what it did.

# %%
person = pm.Skeleton.preset("person14")
walks = synthetic_walks(40, seconds=4)
files = sorted(Path("tracks").glob("*.*"))
if files:
    prepared = read_tracks(files, person, fps=20)
else:
    prepared = film_clips(walks, person, fps=20, views=16)
print(prepared)

tracks = split_tracks(prepared.tracks)
for part in ("train", "validation", "test"):
    names = getattr(tracks.split, part)
    print(f"{part}: {len(getattr(tracks, part))} tracks of {len(names)} clips")

# %% [markdown]
# Tracks of one clip stay together: a clip seen from elsewhere is no new motion. The clips of `test`
# are not looked at until the end. From there on this notebook measures against the truth in 3D,
# which made walks have; with tracks of your own, put motion capture in place of `walks`.
#
# ## 2. A prior that has seen no third dimension
#
# A transformer learns to take noise off windows of 20 frames, one second. (`probmotion train
# diffusion` does it from the command line, in larger sizes. The same call goes on where it was
# stopped.)

# %%
trainee = DiffusionTrainee(tracks.train, tracks.validation, DiffusionSettings.tiny(20))
settings = TrainingSettings(steps=3000, batch=32, learning_rate=2e-3, ema=0.99)
trained = train(trainee, settings, "diffusion", progress=False)
losses = pd.read_csv("diffusion/losses.csv")
print(losses.round(3).to_string(index=False))

# %% [markdown]
# The loss is the squared error of the denoised motion, in units of the data's variance, over all
# noise levels; it never gets to zero, because a motion that is nearly all noise cannot be guessed.
#
# ## 3. Motions in 3D
#
# For a sampler the network is a prior like any other. `mas` denoises five views at once, and
# after every step makes them views of *one* motion.

# %%
prior = MotionDiffusion.load("diffusion")
posterior = pm.MotionPosterior(prior)
mas = MultiViewAncestral(perspective=True)
drawn = mas.sample(posterior, draws=128, seed=0, progress=False).flat()

hidden = [walk for walk in walks if walk.name in tracks.split.test]
real = np.concatenate(
    [windows(centre_motion(walk.retarget(person).resample(20)).positions, 20) for walk in hidden]
)
rows = {"mas": drawn, "real, held out": real[::61]}
draw_skeletons(rows, person, "front.png", heading=0.0, title="From the front")
Image("front.png")

# %%
draw_skeletons(rows, person, "side.png", heading=np.pi / 2, title="From their right")
Image("side.png")

# %% [markdown]
# They are people who walk from either side, though every picture that was learnt from is flat. Drag
# them, or press the arrow keys, to look from elsewhere.

# %%
play_skeletons(rows, person, "walks.html", fps=20)

# %% [markdown]
# ## 4. How good are they?
#
# First as in the paper, in 2D. Draws are filmed from random sides, and an evaluator, the encoder of
# a small autoencoder that learnt the same tracks, makes 2D motions into features. There, draws and
# held-out motions are compared: `fid` is the distance of two Gaussians (0 is best), precision
# the share of draws among real motions, recall the share of real motions among draws. What
# the 2D model itself draws, one view at a time, is the published upper bound.

# %%
trainee = EvaluatorTrainee(tracks.train, tracks.validation, EvaluatorSettings.tiny(20))
settings = TrainingSettings(steps=1000, batch=32, learning_rate=2e-3, ema=0.99)
train(trainee, settings, "evaluator", progress=False)
evaluator = TrackEvaluator.load("evaluator")
held_out = evaluator.features(film_windows(hidden, person, 20, 20, 300, seed=1))
reference = GenerationReference(evaluator, held_out)

plain = MultiViewAncestral(perspective=True, shared_noise=False)
motions = {
    "mas": drawn,
    "mas, no 3D noise": plain.sample(posterior, draws=128, seed=0, progress=False).flat(),
}
views = Ancestral2D().sample_views(posterior, draws=128, seed=0, progress=False)
seen = [walk for walk in walks if walk.name in tracks.split.train]

asked = {"seed": 0, "samples": 128, "repeats": 5}
scores = {
    "real": reference.score_views(film_windows(seen, person, 20, 20, 640, seed=2), **asked),
    "2D model": reference.score_views(views, **asked),
    **{name: reference.score_motions(some, **asked) for name, some in motions.items()},
}
table = pd.DataFrame(
    {name: {key: mean for key, (mean, _) in row.items()} for name, row in scores.items()}
).T
print(table.round(2).to_string())

# %% [markdown]
# What `mas` draws looks no less real than what the 2D model draws: going to 3D costs nothing here,
# and what is missing to real motion is the tiny network's. In the paper recall collapses without
# 3D noise. Not here, where walks are much alike: views of independent noise still agree.
#
# Then what the paper could not do. We know the truth: how far is each draw from the nearest
# real motion that was held out, when turned to it? And is its mirror image, near and far exchanged,
# nearer than itself? In pictures the two are easily confused.

# %%
rng = np.random.default_rng(0)
known = np.concatenate(
    [windows(centre_motion(walk.retarget(person).resample(20)).positions, 20) for walk in seen]
)
motions["real"] = known[rng.choice(len(known), 128)]
for name, some in motions.items():
    near = nearest_distances(some, real)
    print(
        f"{name + ':':18} {1000 * near.of_draws:3.0f} mm to real motion, "
        f"{1000 * near.of_real:3.0f} mm from real motion, "
        f"mirrored {mirrored_fraction(some, real):.2f}"
    )

# %% [markdown]
# Draws are about as near to held-out motion as other real motion is. That is 3D, learnt from
# pictures alone.
#
# ## 5. Cleaning a track
#
# The same denoiser cleans 2D tracks. A poor detector, which errs by 4 cm and at times loses a joint
# altogether, looks at the held-out clips; the denoiser knows how confident it was.

# %%
clips = [walk.retarget(person).resample(20) for walk in hidden]
poor = DetectorNoise(found=0.04, silent=0.0)
detected = project_clips(clips, views=4, noise=poor)
true = project_clips(clips, views=4, noise=DetectorNoise.none())
cleaned = [denoise_track(track, prior, noise=0.04) for track in detected]

lost = np.stack([track.confidence < 0.3 for track in detected])
for name, joints in {"found": ~lost, "lost": lost}.items():
    before, after = (
        np.stack([a.keypoints - b.keypoints for a, b in zip(some, true, strict=True)])[joints]
        for some in (detected, cleaned)
    )
    print(
        f"{name} joints: {1000 * np.linalg.norm(before, axis=-1).mean():.0f} mm as detected, "
        f"{1000 * np.linalg.norm(after, axis=-1).mean():.0f} mm cleaned"
    )


def upright(track: pm.KeypointTrack) -> np.ndarray:
    """Return a track as a flat motion, to be drawn."""
    return np.dstack([track.keypoints * [1, -1], np.zeros(track.confidence.shape)])


shown = slice(3, None, 4)
draw_skeletons(
    {"detected": upright(detected[0])[None, shown], "cleaned": upright(cleaned[0])[None, shown]},
    person,
    "cleaned.png",
    moments=10,
    truth=upright(true[0])[shown],
)
Image("cleaned.png")

# %% [markdown]
# Cleaning pays where the detector errs by more than is left after it, which depends on the network:
# this one is tiny.
#
# ## 6. Evidence
#
# Last, one camera watches a held-out walk, and the posterior is asked what happened in 3D.
# Guidance by evidence wants orthographic views, which those from seven metres nearly are.

# %%
truth = pm.Motion(real[10], person, 20)
camera = pm.Cameras.ring(1, elevation=np.pi / 16)
evidence = pm.Keypoints2D.observe(truth, camera, noise=0.05, seed=0)
guided = MultiViewAncestral().sample(
    pm.MotionPosterior(prior, evidence), draws=12, seed=0, progress=False
)
answers = guided.flat()


def errors(some: np.ndarray) -> np.ndarray:
    """Return the mean distance of each motion's joints to the truth, mm."""
    return 1000 * np.linalg.norm(some - truth.positions, axis=-1).mean(axis=(1, 2))


misses = np.linalg.norm(camera.project(answers)[:, 0] - evidence.keypoints[0], axis=-1)
misses = 1000 * misses.mean(axis=(1, 2))
order = misses.argsort()
print("misses what was seen by, mm:", *misses[order].round().astype(int))
print("misses the truth by, mm:    ", *errors(answers)[order].round().astype(int))
print(f"without evidence: {errors(drawn).mean():.0f} mm")

draw_skeletons(
    {"as the camera\nsees them": answers[order[[0, 1, -1]]]},
    person,
    "guided_front.png",
    elevation=np.pi / 16,
    truth=truth.positions,
)
Image("guided_front.png")

# %%
draw_skeletons(
    {"from the side": answers[order[[0, 1, -1]]]},
    person,
    "guided_side.png",
    azimuth=np.pi / 2,
    truth=truth.positions,
)
Image("guided_side.png")

# %% [markdown]
# Most answers are near the truth also in the direction that the camera does not see. Look at the
# first line before you believe any: guidance is an approximation, and the denoiser one too, so that
# a draw can be caught in something else. Without knowing the truth, it is told by missing what was
# seen by far more than the detector errs, which is here 63 mm on average. The worst stands last.
#
# ## Next
#
# A prior that was trained for longer, on real motion capture, comes with the package:
#
#     probmotion compare walk2d --out learnt
#
# And to learn from tracks of your own:
#
#     probmotion train diffusion --tracks "tracks/*.json" --out mine

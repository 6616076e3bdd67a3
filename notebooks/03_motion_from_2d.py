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
# # 3D motion from 2D data alone
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/03_motion_from_2d.ipynb)
#
# Kapon et al. (2024) learn a diffusion model of motion in *one* view, from 2D tracks. Multi-view ancestral
# sampling (MAS) then denoises several views of one motion together. At every noise level it replaces the
# views' estimates $\hat{x}_0^v$ by the projections of the 3D motion that fits them best,
#
# $$
# \hat{X}_0 = \arg\min_X \sum_v \lVert P_v X - \hat{x}_0^v \rVert^2 .
# $$
#
# This notebook trains a diffusion model on 2D tracks, samples 3D motion and evaluates it. All networks are tiny,
# so that it takes two minutes on one core; `notebooks/ablations/mas.py` is the full study.
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

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
from probmotion.plots.animation import animate_skeletons
from probmotion.plots.skeletons import draw_skeletons
from probmotion.samplers import MultiViewAncestral
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D

# %% [markdown]
# ## 1. Tracks
#
# Put your own keypoint files (COCO, OpenPose or AlphaPose JSON, DeepLabCut, npz) into the folder `tracks`. If
# there are none, synthetic walks are projected to random cameras and detected with errors. The preparation prints
# a report per step.

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
# All tracks of one clip are in one part of the split, because the same motion from another side is not new data.
# The `test` clips are used only at the end. The 3D errors below require the truth, which is known for synthetic
# walks; with your own tracks, replace `walks` by motion capture.
#
# ## 2. A prior learnt from 2D data only
#
# A transformer learns to denoise windows of 20 frames (one second). `probmotion train diffusion` does the same on
# the command line at larger sizes; a stopped run continues with the same call.

# %%
trainee = DiffusionTrainee(tracks.train, tracks.validation, DiffusionSettings.tiny(20))
settings = TrainingSettings(steps=3000, batch=32, learning_rate=2e-3, ema=0.99)
trained = train(trainee, settings, "diffusion", progress=False)
losses = pd.read_csv("diffusion/losses.csv")
print(losses.round(3).to_string(index=False))

# %% [markdown]
# The loss is the squared error of the denoised motion in units of the data's variance, over all noise levels. It
# does not reach zero, because a motion that is nearly all noise cannot be predicted.
#
# ## 3. Motion in 3D
#
# For a sampler, the network is a prior like any other. `mas` denoises five views at once and projects them to
# *one* motion after every step.

# %%
prior = MotionDiffusion.load("diffusion")
posterior = pm.MotionPosterior(prior)
mas = MultiViewAncestral(perspective=True)
drawn = mas.sample(posterior, draws=128, seed=0, progress=False).flat()

test_walks = [walk for walk in walks if walk.name in tracks.split.test]


def segments(clips: list[pm.Motion]) -> np.ndarray:
    """Return all windows of one second, centred on the root."""
    centred = [centre_motion(clip.retarget(person).resample(20)) for clip in clips]
    return np.concatenate([windows(motion.positions, 20) for motion in centred])


real = segments(test_walks)
rows = {"mas": drawn, "real, held out": real[::61]}
draw_skeletons(rows, person, "front.png", heading=0.0, title="From the front")
Image("front.png")

# %%
draw_skeletons(rows, person, "side.png", heading=np.pi / 2, title="From their right")
Image("side.png")

# %% [markdown]
# The draws look like walking people from both directions, although all training data are 2D. Drag the animation,
# or press the arrow keys, to rotate it.

# %%
animate_skeletons(rows, person, "walks.html", fps=20)

# %% [markdown]
# ## 4. Evaluation
#
# The first evaluation is in 2D, as in the paper. Draws are projected from random sides and encoded by an
# evaluator, the encoder of a small autoencoder trained on the same tracks. In feature space, `fid` is the Fréchet
# distance to held-out motion (0 is best), precision the fraction of draws within real motion, and recall the
# fraction of real motion within the draws (1 is best). The 2D model itself, sampled one view at a time, is the
# published upper bound.

# %%
trainee = EvaluatorTrainee(tracks.train, tracks.validation, EvaluatorSettings.tiny(20))
settings = TrainingSettings(steps=1000, batch=32, learning_rate=2e-3, ema=0.99)
train(trainee, settings, "evaluator", progress=False)
evaluator = TrackEvaluator.load("evaluator")
held_out = evaluator.features(film_windows(test_walks, person, 20, 20, 300, seed=1))
reference = GenerationReference(evaluator, held_out)

plain = MultiViewAncestral(perspective=True, shared_noise=False)
motions = {
    "mas": drawn,
    "mas, no 3D noise": plain.sample(posterior, draws=128, seed=0, progress=False).flat(),
}
views = Ancestral2D().sample_views(posterior, draws=128, seed=0, progress=False)
train_walks = [walk for walk in walks if walk.name in tracks.split.train]

real_views = film_windows(train_walks, person, 20, 20, 640, seed=2)
options = {"seed": 0, "samples": 128, "repeats": 5}
scores = {
    "real": reference.score_views(real_views, **options),
    "2D model": reference.score_views(views, **options),
    **{name: reference.score_motions(some, **options) for name, some in motions.items()},
}
table = pd.DataFrame(
    {name: {key: mean for key, (mean, _) in row.items()} for name, row in scores.items()}
).T
print(table.round(2).to_string())

# %% [markdown]
# The scores of MAS are similar to those of the 2D model, so the step to 3D adds no error here; the difference
# from real motion is due to the tiny network. In the paper, recall collapses without 3D noise. It does not here,
# because the walks are similar.
#
# The second evaluation is in 3D, where the truth is known. It measures the distance between each draw and the
# closest held-out motion after alignment about the vertical axis, and the fraction of draws whose mirror image in
# depth is closer. Mirror images are hard to distinguish in 2D.

# %%
rng = np.random.default_rng(0)
known = segments(train_walks)
motions["real"] = known[rng.choice(len(known), 128)]
for name, some in motions.items():
    distances = nearest_distances(some, real)
    print(
        f"{name + ':':18} {1000 * distances.of_draws:3.0f} mm to real motion, "
        f"{1000 * distances.of_real:3.0f} mm from real motion, "
        f"mirrored {mirrored_fraction(some, real):.2f}"
    )

# %% [markdown]
# Draws are about as close to held-out motion as other real motion is, although the prior was learnt from 2D data
# alone.
#
# ## 5. Denoising a track
#
# The same denoiser can clean 2D tracks. Here, a detector with errors of 4 cm and missing joints observes the
# held-out clips; the denoiser uses the confidence of the detections.

# %%
clips = [walk.retarget(person).resample(20) for walk in test_walks]
noise = DetectorNoise(found=0.04, silent=0.0)
detected = project_clips(clips, views=4, noise=noise)
true = project_clips(clips, views=4, noise=DetectorNoise.none())
cleaned = [denoise_track(track, prior, noise=0.04) for track in detected]

lost = np.stack([track.confidence < 0.3 for track in detected])
for name, joints in {"detected": ~lost, "lost": lost}.items():
    before, after = (
        np.stack([a.keypoints - b.keypoints for a, b in zip(some, true, strict=True)])[joints]
        for some in (detected, cleaned)
    )
    print(
        f"{name} joints: {1000 * np.linalg.norm(before, axis=-1).mean():.0f} mm before denoising, "
        f"{1000 * np.linalg.norm(after, axis=-1).mean():.0f} mm after"
    )


def in_plane(track: pm.KeypointTrack) -> np.ndarray:
    """Return a track as a motion at depth 0, for figures."""
    return np.dstack([track.keypoints * [1, -1], np.zeros(track.confidence.shape)])


shown = slice(3, None, 4)
draw_skeletons(
    {"detected": in_plane(detected[0])[None, shown], "cleaned": in_plane(cleaned[0])[None, shown]},
    person,
    "cleaned.png",
    moments=10,
    truth=in_plane(true[0])[shown],
)
Image("cleaned.png")

# %% [markdown]
# Denoising helps only where the errors of the detector exceed those of this tiny network.
#
# ## 6. Conditioning on observations
#
# Finally, one camera observes a held-out walk, and `mas` samples the posterior. Guidance requires orthographic
# views, which approximate views from seven metres.

# %%
truth = pm.Motion(real[10], person, 20)
camera = pm.Cameras.ring(1, elevation=np.pi / 16)
keypoints = pm.Keypoints2D.observe(truth, camera, noise=0.05, seed=0)
guided = MultiViewAncestral().sample(
    pm.MotionPosterior(prior, keypoints), draws=12, seed=0, progress=False
)
draws = guided.flat()


def errors(some: np.ndarray) -> np.ndarray:
    """Return the mean distance of each motion's joints to the truth, mm."""
    return 1000 * np.linalg.norm(some - truth.positions, axis=-1).mean(axis=(1, 2))


image_errors = np.linalg.norm(camera.project(draws)[:, 0] - keypoints.keypoints[0], axis=-1)
image_errors = 1000 * image_errors.mean(axis=(1, 2))
order = image_errors.argsort()
print("error against observations, mm:", *image_errors[order].round().astype(int))
print("error against truth, mm:       ", *errors(draws)[order].round().astype(int))
print(f"without observations: {errors(drawn).mean():.0f} mm")

draw_skeletons(
    {"as the camera\nsees them": draws[order[[0, 1, -1]]]},
    person,
    "guided_front.png",
    elevation=np.pi / 16,
    truth=truth.positions,
)
Image("guided_front.png")

# %%
draw_skeletons(
    {"from the side": draws[order[[0, 1, -1]]]},
    person,
    "guided_side.png",
    azimuth=np.pi / 2,
    truth=truth.positions,
)
Image("guided_side.png")

# %% [markdown]
# Most draws are close to the truth, also in depth. Guidance is approximate, so single draws can be stuck in a
# local optimum. They can be recognised without the truth: their error against the observations is far above that
# of the detector, here 63 mm on average. The draw with the largest error is shown last.
#
# ## Next
#
# The package includes a prior trained for longer on real motion capture:
#
#     probmotion compare walk2d --out learnt
#
# To train on your own tracks:
#
#     probmotion train diffusion --tracks "tracks/*.json" --out mine

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
# # From one image to a moving body
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/09_from_one_image.ipynb)
#
# `pm.reconstruct` estimates the surface, pose, colours and motion of an animal or a person from one image and its mask,
# with their uncertainty. Here, the image is made, so that the truth is known: how right is the body, and what does one
# image leave open?
#
# With an image of your own, one command does the rest:
#
#     probmotion reconstruct dog.png --mask dog-mask.png --category quadruped --out dog
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from PIL import Image

import probmotion as pm
from probmotion.models.images import ImageObservation
from probmotion.models.images.category import Category
from probmotion.models.images.made_images import make_images
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.plots.animation import animate_skeletons

# %% [markdown]
# ## 1. An image and its mask
#
# A *category* is what is known of all bodies of one kind: a surface, its deformations and colours, and how bones rotate.
# `SurfacePrior` is the prior p(θ) of one such body in front of a camera: θ ~ N(0, I) has the code of the motion, the lengths
# of bones, shape, colours, light and the pose relative to the camera. The image is a draw of it, and its mask has errors
# along the outline.

# %%
category = Category.load("quadruped")
tangent = 0.15  # of half the field of view
prior = SurfacePrior(category, np.array([tangent]))
made = make_images(prior, np.random.default_rng(1), 1, 128)
for name, pixels in {"image": made.rgb[0], "mask": made.mask[0]}.items():
    Image.fromarray(np.round(255 * pixels).astype(np.uint8)).save(f"{name}.png")
print(
    f"{category.surface.vertices.shape[0]} vertices, {len(category.body.bones)} bones, θ: {prior.dim}"
)

# %% [markdown]
# ## 2. The reconstruction
#
# `ImageObservation.read` crops the image around the body. A network proposes directions, poses and shapes, which are
# refined until rendered images agree with the observed one: modes of the posterior. Draws are from Gaussians about them.
# The first sentence of the summary says whether a body of the category explains the image.

# %%
fov = 2 * np.degrees(np.arctan(tangent))
observation = ImageObservation.read("image.png", "mask.png", fov=fov)
result = pm.reconstruct(observation, category)
print("\n".join(result.summary()))
pd.DataFrame(
    [(check.name, check.value, check.limit, check.passed) for check in result.checks],
    columns=["check", "value", "at most", "passed"],
).round(2)


# %%
def picture(prior, theta):
    """Return the rendered image of θ on white, (S, S, 3)."""
    with torch.no_grad():
        image = prior.render(torch.as_tensor(theta[None], dtype=torch.float32), 128)[0, 0].numpy()
    return np.clip(image[..., :3] + 1 - image[..., 3:], 0, 1)


view = result.prior.layout.view.start
yaw = np.arctan2(result.theta[view], result.theta[view + 1])
turned = result.prior.facing(result.theta[None], yaw + np.pi / 2)
smaller = result.prior.moved(turned, np.zeros((1, 2)), np.array([1.5]))[0]
shown = {
    "image": observation.rgb[0],
    "mask": observation.mask[0],
    "most probable body": picture(result.prior, result.theta),
    "turned by 90°, smaller": picture(result.prior, smaller),
}
fig, axes = plt.subplots(1, 4, figsize=(8, 2.3))
for ax, (title, pixels) in zip(axes, shown.items(), strict=True):
    ax.imshow(pixels, cmap="gray", vmin=0, vmax=1)
    ax.set_title(title, fontsize=9)
    ax.axis("off")
fig.tight_layout()

# %% [markdown]
# ## 3. The truth
#
# One image determines no size: a small animal close to the camera looks like a large one far away. Joints are therefore
# compared relative to their middle and in the size of the truth. The crop's camera looks at the body, and its axes are
# turned accordingly.

# %%
flip = np.diag([1.0, -1.0, -1.0])  # from the camera's axes to those of motions
truth = prior.motion(made.theta)[0, 0] @ (flip @ observation.rotation[0] @ flip).T
length = np.ptp(category.body.rest_positions[:, 2])


def about_middle(joints, truth):
    """Return joints (…, J, 3) relative to their middle, in the size of the truth."""
    joints = joints - joints.mean(axis=-2, keepdims=True)
    truth = truth - truth.mean(axis=0)
    size = np.linalg.norm(truth) / np.linalg.norm(joints, axis=(-1, -2), keepdims=True)
    return size * joints


def spread(joints, truth):
    """Return what draws of joints (n, J, 3) say."""
    draws, true = about_middle(joints, truth), about_middle(truth, truth)
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    return {
        "sd across the image, mm": 1000 * draws[..., :2].std(axis=0).mean(),
        "sd in depth, mm": 1000 * draws[..., 2].std(axis=0).mean(),
        "90 % intervals contain, %": 100 * ((true >= low) & (true <= high)).mean(),
    }


def compared(result, truth):
    """Return errors and spread of a reconstruction."""
    error = about_middle(result.prior.motion(result.theta)[0], truth) - about_middle(truth, truth)
    return {
        "intersection over union": result.mask_iou,
        "error of joints, % of the length": 100 * np.linalg.norm(error, axis=-1).mean() / length,
        "draws that face right, %": 100 * (result.facing > 0).mean(),
        "draws that face away, %": 100 * (np.abs(result.facing) > 90).mean(),
        **spread(result.joints, truth),
    }


pd.Series(compared(result, truth)).round(2)

# %% [markdown]
# ## 4. What one image leaves open
#
# Seen from behind, an animal and its mirror image have nearly the same silhouette, and depth is seen only through
# perspective. Another image shows what remains: below, draws given its mask alone, seen by the camera and from above, where
# it did not look; and draws given its colours, too. The truth is in black. Here, the mask tells that the animal faces
# away; one draw in nine faces slightly to the right given the mask alone, and nine in ten given the colours, too. The guide
# to `probmotion reconstruct` has the errors of many images.

# %%
other = make_images(prior, np.random.default_rng(21), 1, 128)
other_truth = prior.motion(other.theta)[0, 0]
results = {
    name: pm.reconstruct(
        ImageObservation(other.mask, rgb, None, prior.tangent, np.eye(3)[None]), category
    )
    for name, rgb in {"mask alone": None, "image and mask": other.rgb}.items()
}


def draw_bodies(ax, joints, up, title):
    """Draw 30 of the draws of joints, and the truth, from the camera (up 1) or above (up 2)."""
    signs = np.array([1, -1 if up == 2 else 1])  # the camera is below the view from above
    poses = [*((pose, "tab:orange", 0.4) for pose in joints[:30]), (other_truth, "k", 1.5)]
    for pose, colour, width in poses:
        body = about_middle(pose, other_truth)[:, [0, up]] * signs
        for bone in category.body.skeleton.bones:
            ax.plot(*body[list(bone)].T, color=colour, linewidth=width)
    ax.set(aspect="equal", xlim=(-0.6, 0.6), ylim=(-0.75, 0.75), xticks=[], yticks=[])
    ax.set_title(title, fontsize=9)


fig, axes = plt.subplots(1, 4, figsize=(8, 2.6))
axes[0].imshow(other.rgb[0])
axes[0].set_title("image", fontsize=9)
axes[0].axis("off")
draw_bodies(axes[1], results["mask alone"].joints, 1, "mask alone: camera")
draw_bodies(axes[2], results["mask alone"].joints, 2, "mask alone: above")
draw_bodies(axes[3], results["image and mask"].joints, 2, "image and mask: above")
fig.tight_layout()
pd.DataFrame({name: compared(each, other_truth) for name, each in results.items()}).round(2)

# %% [markdown]
# ## 5. Another sampler
#
# The draws above are from Gaussians about modes that are wider than the posterior: they count 2 % of the image's
# information, and modes are weighted by a power of their evidence. An image is an observation like any other, and
# `pm.posterior(prior, observation)` is the posterior for every sampler of densities. Metropolis-Hastings starts at the draws
# and approximates nothing, but in a minute it does not converge: the density has many narrow modes, and chains keep much of
# the spread of their starts. They show that the draws lead to bodies of higher density, not how wide the posterior is.

# %%
silhouette = results["mask alone"]
posterior = pm.posterior(silhouette.prior, silhouette.observation)
chains = pm.samplers.MetropolisHastings(warmup=500, thin=10).sample(
    posterior, draws=10, chains=10, initial=silhouette.draws[:10], progress=False
)
joints = chains.positions.values[:, :, 0].reshape(-1, *truth.shape)
shuffled = np.random.default_rng(0).permutation(joints)
fig, axes = plt.subplots(1, 4, figsize=(8, 2.6))
draw_bodies(axes[0], silhouette.joints, 1, "pm.reconstruct: camera")
draw_bodies(axes[1], silhouette.joints, 2, "above")
draw_bodies(axes[2], shuffled, 1, "Metropolis-Hastings: camera")
draw_bodies(axes[3], shuffled, 2, "above")
fig.tight_layout()
drawn = {
    "pm.reconstruct": (silhouette.joints, posterior.log_density(silhouette.draws)),
    "Metropolis-Hastings": (joints, chains.dataset["log_density"].values),
}
pd.DataFrame(
    {
        name: spread(draws, other_truth) | {"mean log density": density.mean()}
        for name, (draws, density) in drawn.items()
    }
).round(2)

# %% [markdown]
# ## 6. Take it home
#
# Every draw is also a motion: it starts at the pose in the image, and the code of the motion says how it goes on. `save`
# writes a page for the browser (`reconstruct.html`: the outline over the image, other views, and draws as moving
# surfaces), and `body.glb`, the textured surface with its skeleton and four motions.
#
# In Blender: *File ▸ Import ▸ glTF 2.0* reads `body.glb`.

# %%
result.save("animal")
moving = pm.load("animal/reconstruction.npz")
print(f"{moving}, rotations {moving.rotations.shape}")
count = category.body.skeleton.n_joints
motions = np.stack([result.motion(k).positions[:, :count] for k in range(3)])
motions -= motions[:, :1].mean(axis=2, keepdims=True)
animate_skeletons({"three draws": motions}, category.body.skeleton, fps=moving.fps)

# %% [markdown]
# ## 7. When not to trust it
#
# Checks compare the most probable body with the mask, and its shape with those of the category: no animal has the
# silhouette of a star or of a square. They do not see more than that. A failed check is a reason to look, and a passed
# one is no proof.

# %%
rows, columns = np.mgrid[:96, :96] - 47.5
star = np.hypot(rows, columns) < 24 + 14 * np.cos(5 * np.arctan2(rows, columns))
square = np.maximum(np.abs(rows), np.abs(columns)) < 28
for name, shape in {"a star": star, "a square": square}.items():
    wrong = ImageObservation.read(shape.astype(float), shape.astype(float))
    print(f"{name}: {pm.reconstruct(wrong, category, draws=2).summary()[0]}")

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
# # Which sampler, and how wrong is it?
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/06_compare_and_calibrate.ipynb)
#
# Samplers are compared on problems with known answers and equal budgets, their uncertainty is checked by
# simulation-based calibration, and the error of one of them is decomposed into parts.
#
# On Colab, first run `%pip install git+https://github.com/probmotion/probmotion`.

# %%
from pathlib import Path

import pandas as pd
from IPython.display import Image

import probmotion as pm
from probmotion.calibration import Overconfident, calibrate
from probmotion.calibration.error_decomposition import decompose_error
from probmotion.comparison import Budget, advise
from probmotion.problems import load_problem
from probmotion.samplers import ExactSampler, MetropolisHastings, MultiViewAncestral

# %% [markdown]
# ## 1. A problem of adjustable difficulty
#
# Here: eight frames, one camera, keypoints with σ = 5 cm, so that depth is nearly unknown.

# %%
problem = load_problem("gait-monocular", frames=8, noise=0.05)
print(problem.name, "has exact draws:", problem.has_reference)

# %% [markdown]
# ## 2. The same budget for all
#
# Every sampler may evaluate a density or a denoiser 20 000 times (a gradient counts twice); pilot runs find the
# setting that spends the budget. `exact` needs none and shows how close one can get.

# %%
samplers = {
    "exact": ExactSampler(),
    "mh": MetropolisHastings(),
    "mas": MultiViewAncestral(),
}
comparison = pm.compare(
    problem,
    samplers,
    draws=40,
    chains=4,
    seeds=3,
    budget=Budget(evaluations=20_000),
    out="comparison",
    progress=False,
)
print(comparison.table())

# %% [markdown]
# Three seeds show how much of a difference is chance: the report highlights the best sampler and all that are
# statistically tied with it. It is one HTML file with the table, quality against cost, and animated draws beside
# exact ones with the keypoints on top.

# %%
page = comparison.report("report.html")
print(page.name, f"{Path(page).stat().st_size / 1e6:.1f} MB")

# %%
comparison.plot("quality.png")
Image("quality.png")

# %% [markdown]
# ## 3. Are they calibrated?
#
# A truth $\theta^\ast$ is drawn from the prior and observations from the likelihood. Over many simulations the rank
# of $f(\theta^\ast)$ among the draws,
#
# $$
# r = \sum_{i=1}^{n} \mathbb{1}\left[ f(\theta_i) < f(\theta^\ast) \right],
# $$
#
# is uniform on $0, \dots, n$ if the sampler is right. `Overconfident` shrinks the draws of another sampler: the
# negative control that must fail.

# %%
calibration = calibrate(
    problem,
    {"exact": ExactSampler(), "overconfident": Overconfident(ExactSampler())},
    simulations=60,
    draws=40,
    out="comparison",
    progress=False,
)
for name in ("exact", "overconfident"):
    print(calibration.verdict(problem.name, name))

# %%
calibration.plot("calibration.png")
Image("calibration.png")

# %% [markdown]
# ## 4. Where does the error of MAS come from?
#
# A chain of samplers leads from exact draws to MAS; neighbours differ in one property, and the differences add up
# to the total error.

# %%
errors = decompose_error(
    load_problem("gait", frames=8), steps=50, seeds=3, draws=60, progress=False
)
table = errors.table()
print(table[table["measure"] == "spread"].drop(columns="measure").round(2).to_string(index=False))
for sentence in errors.notes:
    print(sentence)

# %%
errors.plot("errors.png")
Image("errors.png")

# %% [markdown]
# ## 5. Which sampler, then?
#
# Every sampler was measured on every problem of the package with a small budget. `probmotion which` prints the same
# on the command line.

# %%
print(advise("gait-monocular"))

# %% [markdown]
# ## 6. Your own
#
# Any posterior and any object with `name`, `requires` and `sample` can take part; packages register samplers by an
# entry point of the group `probmotion.samplers`.

# %%
table = pm.compare(
    {"mine": pm.MotionPosterior(problem.posterior.prior)},
    {"exact": ExactSampler(), "mh": MetropolisHastings()},
    draws=40,
    progress=False,
).table()
print(pd.DataFrame(table).query("metric == 'seconds'")[["sampler", "value"]].to_string(index=False))

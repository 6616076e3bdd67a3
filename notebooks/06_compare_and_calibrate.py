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
# # Comparison and calibration of samplers
#
# [![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/probmotion/probmotion/blob/main/notebooks/06_compare_and_calibrate.ipynb)
#
# Samplers are compared on problems with known posteriors and equal budgets, their uncertainty is checked by
# simulation-based calibration, and the error of one of them is decomposed into parts.
#
# On Colab, first run `%pip install 'probmotion[all] @ git+https://github.com/probmotion/probmotion'`.

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
# This problem has eight frames and one camera. Keypoints have a standard deviation of 5 cm, so depth is nearly
# undetermined.

# %%
problem = load_problem("gait-monocular", frames=8, noise=0.05)
print(problem.name, "has exact draws:", problem.has_reference)

# %% [markdown]
# ## 2. The same budget for all
#
# Every sampler may evaluate a density or a denoiser 20 000 times (a gradient counts twice); pilot runs select the
# setting that uses the budget. `exact` requires no evaluations and shows the smallest attainable error.

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
# The variation over three seeds shows which differences are significant: the report highlights the best sampler
# and all that are statistically tied with it. The report is one HTML file with the table, a figure of quality
# against cost, and animated draws beside exact draws, with the keypoints.

# %%
report = comparison.report("report.html")
print(report.name, f"{Path(report).stat().st_size / 1e6:.1f} MB")

# %%
comparison.plot("quality.png")
Image("quality.png")

# %% [markdown]
# ## 3. Calibration
#
# A truth $\theta^\ast$ is drawn from the prior and observations from the likelihood. Over many simulations the rank
# of $f(\theta^\ast)$ among the draws,
#
# $$
# r = \sum_{i=1}^{n} \mathbb{1}\left[ f(\theta_i) < f(\theta^\ast) \right],
# $$
#
# is uniform on $0, \dots, n$ if the sampler is correct. `Overconfident` shrinks the draws of another sampler. It
# is a negative control, which the test must reject.

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
# ## 4. Decomposition of the error of MAS
#
# A chain of samplers leads from exact draws to multi-view ancestral sampling (MAS). Consecutive samplers differ
# in one property, and the differences add up to the total error.

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
# ## 5. Choice of a sampler
#
# Every sampler was measured on every problem of the package with a small budget. `probmotion which` prints the
# same advice on the command line.

# %%
print(advise("gait-monocular"))

# %% [markdown]
# ## 6. Your own posterior or sampler
#
# Any posterior can be compared, and any object with `name`, `requires` and `sample` can be used as a sampler.
# Packages register samplers by an entry point of the group `probmotion.samplers`.

# %%
table = pm.compare(
    {"mine": pm.MotionPosterior(problem.posterior.prior)},
    {"exact": ExactSampler(), "mh": MetropolisHastings()},
    draws=40,
    progress=False,
).table()
print(pd.DataFrame(table).query("metric == 'seconds'")[["sampler", "value"]].to_string(index=False))

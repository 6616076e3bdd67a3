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
# # Which sampler, and how wrong is it?
#
# Samplers of one posterior are compared on problems whose answer is known, within the same budget;
# what they claim about their own uncertainty is checked against simulated evidence; and where one
# is wrong, its error is split into parts.

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
# ## 1. A problem, as hard as one likes
#
# What makes a problem hard is a number in its name. Here eight frames of one camera, keypoints with
# σ = 5 cm: depth is all but unknown.

# %%
problem = load_problem("gait-monocular", frames=8, noise=0.05)
print(problem.name, "has exact draws:", problem.has_reference)

# %% [markdown]
# ## 2. The same budget for all
#
# Every sampler may evaluate a density or a denoiser 20 000 times (a gradient counts as two); pilot
# runs find the setting that spends it. `exact` needs none, and says how near one can come.

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
# Three seeds say how much of a difference is chance: the page marks the best, and all that cannot
# be told from it. It holds the table, quality against cost, and draws that play beside exact ones
# with the keypoints over them. It is one file: open `report.html` in a browser.

# %%
page = comparison.report("report.html")
print(page.name, f"{Path(page).stat().st_size / 1e6:.1f} MB")

# %%
comparison.plot("quality.png")
Image("quality.png")

# %% [markdown]
# ## 3. Do they know how wrong they are?
#
# A truth is drawn from the prior, evidence is made of it, and its rank among the sampler's draws is
# kept; over many simulations the ranks of a sampler that is right are uniform. `Overconfident`
# pulls the draws of another sampler together: the control that has to fail.

# %%
calibration = calibrate(
    problem,
    {"exact": ExactSampler(), "too sure": Overconfident(ExactSampler())},
    simulations=60,
    draws=40,
    out="comparison",
    progress=False,
)
for name in ("exact", "too sure"):
    print(calibration.verdict(problem.name, name))

# %%
calibration.plot("calibration.png")
Image("calibration.png")

# %% [markdown]
# ## 4. Where does MAS's error come from?
#
# A chain of samplers between exact draws and MAS, each of which differs from the one before in one
# thing; the differences add up to the whole.

# %%
budget = decompose_error(
    load_problem("gait", frames=8), steps=50, seeds=3, draws=60, progress=False
)
found = budget.table()
print(found[found["measure"] == "spread"].drop(columns="measure").round(2).to_string(index=False))
for sentence in budget.notes:
    print(sentence)

# %%
budget.plot("bias.png")
Image("bias.png")

# %% [markdown]
# ## 5. Which sampler, then?
#
# Every sampler was measured on every problem of the library, with a small budget; `probmotion
# which` says the same on the command line.

# %%
print(advise("gait-monocular"))

# %% [markdown]
# ## 6. Your own
#
# Any posterior and any object with `name`, `requires` and `sample` take part; a package registers a
# sampler by an entry point of the group `probmotion.samplers`.

# %%
clips = pm.compare(
    {"mine": pm.MotionPosterior(problem.posterior.prior)},
    {"exact": ExactSampler(), "mh": MetropolisHastings()},
    draws=40,
    progress=False,
).table()
print(pd.DataFrame(clips).query("metric == 'seconds'")[["sampler", "value"]].to_string(index=False))

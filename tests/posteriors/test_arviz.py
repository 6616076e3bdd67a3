"""Draws in ArviZ: schema, diagnostics, leave-one-out, plots and netCDF of a real NUTS run."""

import arviz_stats
import matplotlib as mpl
import matplotlib.style
import numpy as np
import pytest
import xarray as xr

import probmotion as pm
from probmotion.posteriors.finished import FinishedDraws

mpl.use("agg")


@pytest.fixture(scope="module")
def posterior():
    problem = pm.problem("gait-monocular(frames=4)")
    likelihood = problem.posterior.likelihood
    confidence = likelihood.confidence.copy()
    confidence[:, 1, 3] = 0.0
    confidence[:, 2] = 0.5
    seen = pm.Keypoints2D(likelihood.keypoints, likelihood.cameras, likelihood.noise, confidence)
    return pm.posterior(problem.posterior.prior, seen)


@pytest.fixture(scope="module")
def draws(posterior):
    return pm.sample(posterior, "nuts", draws=200, progress=False, warmup=150)


@pytest.fixture(scope="module")
def tree(draws):
    return draws.to_arviz()


def test_the_groups_follow_the_schema(draws, tree, posterior):
    assert {*tree.children} == {"posterior", "sample_stats", "log_likelihood", "observed_data"}
    positions = tree["posterior"]["positions"]
    assert positions.dims == ("chain", "draw", "frame", "joint", "axis")
    assert {*positions.coords} == {*positions.dims}
    names = posterior.skeleton.joint_names
    knee = positions.sel(joint="left_knee", axis="y", frame=2)
    np.testing.assert_array_equal(
        knee, draws.positions.values[:, :, 2, names.index("left_knee"), 1]
    )
    statistics = tree["sample_stats"]
    assert {*statistics.data_vars} == {
        "lp", "acceptance_rate", "diverging", "n_steps", "energy",
    }  # fmt: skip
    assert all(values.dims == ("chain", "draw") for values in statistics.data_vars.values())
    # The energy is the potential −log p plus the kinetic energy ½ pᵀ M⁻¹ p.
    assert (statistics["energy"] > -statistics["lp"]).all()
    kinetic = (statistics["energy"] + statistics["lp"]).mean()
    assert kinetic == pytest.approx(posterior.dim / 2, rel=0.1)
    attributes = tree["posterior"].attrs
    assert attributes["inference_library"] == "probmotion"
    assert attributes["sampling_time"] == draws.seconds


def test_the_pointwise_log_likelihood_sums_to_the_log_likelihood(draws, tree, posterior):
    pointwise = tree["log_likelihood"]["keypoints"]
    wanted = posterior.likelihood.log_density(draws.positions.values)
    np.testing.assert_allclose(pointwise.sum("observation"), wanted)
    assert not ((pointwise["frame"] == 1) & (pointwise["joint"] == "right_ankle")).any()
    observed = tree["observed_data"]["keypoints"].set_index(
        observation=["view", "frame", "joint"]
    ).unstack("observation")  # fmt: skip
    names = list(posterior.skeleton.joint_names)
    grid = observed.sel(joint=names).transpose("view", "frame", "joint", "image_axis").values
    hidden = posterior.likelihood.confidence == 0
    assert np.isnan(grid[hidden]).all()
    np.testing.assert_array_equal(grid[~hidden], posterior.likelihood.keypoints[~hidden])


@pytest.mark.parametrize("degrees_of_freedom", [None, 3.0])
def test_other_likelihoods(degrees_of_freedom):
    skeleton = pm.Skeleton(["hip", "knee"], [-1, 0])
    rng = np.random.default_rng(0)
    joints = pm.Joints3D(
        rng.standard_normal((3, 2, 3)), 0.2, rng.random((3, 2)) + 0.1, degrees_of_freedom, skeleton
    )
    positions = rng.standard_normal((5, 3, 2, 3))
    pointwise = joints.pointwise_log_density(positions)
    assert pointwise.shape == (5, 6)
    np.testing.assert_allclose(pointwise.sum(-1), joints.log_density(positions))


@pytest.mark.filterwarnings("ignore:Estimated shape parameter")
def test_diagnostics_and_leave_one_out(tree):
    table = arviz_stats.summary(tree, var_names=["theta"])
    assert len(table) == tree["posterior"].sizes["coordinate"]
    assert (table["r_hat"].astype(float) < 1.2).all()
    assert (arviz_stats.bfmi(tree)["energy"] > 0.3).all()
    result = arviz_stats.loo(tree, pointwise=True)
    pointwise = tree["log_likelihood"]["keypoints"]
    assert result.n_data_points == pointwise.sizes["observation"]
    assert 0 < result.p < pointwise.sizes["observation"]
    assert result.elpd < pointwise.sum("observation").mean()
    assert {*result.elpd_i.groupby("joint").mean()["joint"].values} > {"left_knee", "neck"}


def test_the_tree_survives_netcdf(tree, draws, posterior, tmp_path):
    tree.to_netcdf(tmp_path / "tree.nc")
    with xr.open_datatree(tmp_path / "tree.nc") as opened:
        loaded = opened.load()
    for name, group in tree.children.items():
        xr.testing.assert_equal(loaded[name].to_dataset(), group.to_dataset())
    again = FinishedDraws.of(loaded).sample(posterior)
    np.testing.assert_array_equal(again.positions, draws.positions)
    assert again.dataset.attrs["sampler"] == "nuts"
    xr.testing.assert_equal(
        again.to_arviz()["sample_stats"].to_dataset(), tree["sample_stats"].to_dataset()
    )
    draws.save(tmp_path / "draws.nc")
    reloaded = pm.MotionDraws.load(tmp_path / "draws.nc")
    assert {*reloaded.to_arviz().children} == {"posterior", "sample_stats"}
    xr.testing.assert_equal(
        reloaded.to_arviz(posterior.likelihood)["log_likelihood"].to_dataset(),
        tree["log_likelihood"].to_dataset(),
    )


@pytest.mark.filterwarnings("ignore")  # of arviz-plots
def test_plots(tree, monkeypatch):
    # Matplotlib 3.11 removed the module from which arviz-plots 0.8 registers its styles.
    monkeypatch.setattr(mpl.style, "core", mpl.style, raising=False)
    plots = pytest.importorskip("arviz_plots")
    coords = {"coordinate": [0, 1, 2]}
    options = {"var_names": ["theta"], "coords": coords, "backend": "matplotlib"}
    with mpl.rc_context():
        plots.style.use("arviz-variat")
        plots.plot_pair(tree, **options)
        plots.plot_rank(tree, **options)
        where = {"joint": "left_knee", "frame": [0, 3], "axis": "y"}
        rank = plots.plot_rank(tree, **options | {"var_names": ["positions"], "coords": where})
    (figure,) = {axes.figure for axes in rank.viz["plot"]["positions"].values.ravel()}
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == [f"positions\n{frame}" for frame in (0, 3)]
    mpl.pyplot.close("all")

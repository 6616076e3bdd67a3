"""Groups of an ArviZ tree: posterior, statistics, pointwise log likelihood and observations."""

from __future__ import annotations

from importlib.metadata import version

import numpy as np
import xarray as xr

from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.protocols import Likelihood

__all__ = ["observation_groups", "posterior_groups"]

_MAX_INTEGER = 2**63 - 1  # largest integer attribute of netCDF-4


def posterior_groups(dataset: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the groups ``posterior`` and ``sample_stats`` of a dataset of draws."""
    variables = [name for name in ("positions", "theta") if name in dataset]
    statistics = {
        ("lp" if name == "log_density" else str(name)): values
        for name, values in dataset.data_vars.items()
        if values.dims[:1] == ("chain",) and name not in variables
    }
    attributes = {
        name: str(value) if isinstance(value, int) and abs(value) > _MAX_INTEGER else value
        for name, value in dataset.attrs.items()
    }
    attributes |= {
        "inference_library": "probmotion",
        "inference_library_version": version("probmotion"),
        "sampling_time": dataset.attrs["seconds"],
    }
    posterior = dataset[variables].assign_attrs(attributes)
    return {"posterior": posterior, "sample_stats": xr.Dataset(statistics)}


def observation_groups(likelihood: Likelihood, positions: xr.DataArray) -> dict[str, xr.Dataset]:
    """Return the groups ``log_likelihood`` and ``observed_data``; none if not pointwise.

    ``positions`` are (chain, draw, frame, joint, axis), metres.
    """
    if isinstance(likelihood, Keypoints2D):
        name, values, component = "keypoints", likelihood.keypoints, "image_axis"
    elif isinstance(likelihood, Joints3D):
        name, values, component = "joints", likelihood.joints, "axis"
    else:
        return {}
    visible = likelihood.entries.visible
    *view, frame, joint = np.nonzero(visible)
    coordinates: dict[str, object] = {
        "observation": np.arange(len(frame)),
        "frame": ("observation", frame),
        "joint": ("observation", positions["joint"].values[joint]),
        component: ["x", "y", "z"][: values.shape[-1]],
    }
    if view:
        coordinates["view"] = ("observation", view[0])
    observed = xr.Dataset({name: (("observation", component), values[visible])}, coordinates)
    log_density = likelihood.pointwise_log_density(positions.values)
    terms = xr.DataArray(
        log_density,
        {name: positions[name] for name in ("chain", "draw")},
        ("chain", "draw", "observation"),
    )
    pointwise = xr.Dataset({name: terms}).assign_coords(
        {key: values for key, values in observed.coords.items() if key != component}
    )
    return {"log_likelihood": pointwise, "observed_data": observed}

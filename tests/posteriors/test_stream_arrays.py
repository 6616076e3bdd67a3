"""Arrays of streamed draws: changed descriptions and damaged chunks are refused in a sentence."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

import probmotion as pm
from probmotion.posteriors import streams


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    """Folder of 40 draws in several chunks."""
    folder = tmp_path_factory.mktemp("stream")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streams, "_BLOCK_BYTES", 80_000)
        pm.sample(
            pm.problem("gait-monocular", frames=6).posterior,
            pm.samplers.MetropolisHastings(warmup=20, thin=1),
            draws=40, chains=2, stream=folder, progress=False,
        )  # fmt: skip
    return folder


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("order", "F"),
        ("dimension_separator", "/"),
        ("compressor", None),
        ("dtype", "<i8"),
        ("dtype", ">f8"),
        ("chunks", [2, 0, 6, 17, 3]),
        ("chunks", [1, 2, 6, 17, 3]),
        ("shape", [2, 10, 6, 17, 3]),
    ],
)
def test_changed_descriptions_are_not_believed(name, value, stream):
    path = stream / "draws.zarr" / "positions" / ".zarray"
    content = path.read_text()
    described = json.loads(content)
    assert described[name] != value
    path.write_text(json.dumps(described | {name: value}))
    with pytest.raises(ValueError, match=r"positions is damaged: .*stream to another folder"):
        pm.open_draws(stream)
    path.write_text(content)


def test_selections_are_those_of_an_array(stream):
    positions = pm.open_draws(stream).positions
    loaded = positions.copy(data=positions.values)
    for key in (
        {"draw": slice(None, None, -3)},
        {"draw": [9, 0, 9], "chain": [1]},
        {"draw": [], "joint": 2, "axis": -1},
    ):
        got = pm.open_draws(stream).positions.isel(key)
        np.testing.assert_array_equal(got, loaded.isel(key))


def test_cut_chunks_are_refused(stream):
    path = stream / "draws.zarr" / "theta" / "0.1.0"
    content = path.read_bytes()
    os.truncate(path, len(content) - 1)
    with pytest.raises(ValueError, match=rf"theta/0.1.0 is damaged: .* {len(content)} bytes"):
        pm.open_draws(stream)
    path.write_bytes(content)

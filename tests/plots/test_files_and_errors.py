"""Files and error messages of all figures."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.data.synthetic.gaits import make_gait
from probmotion.plots.calibration_curves import draw_calibration
from probmotion.plots.coverage import classical_scaling, draw_coverage, draw_embedding
from probmotion.plots.error_plots import draw_error_decomposition
from probmotion.plots.generation import draw_generation
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.quality import plot_quality_against_cost
from probmotion.plots.ranks import draw_ranks
from probmotion.plots.skeletons import draw_skeletons
from probmotion.plots.spread import plot_spread
from probmotion.plots.style import COLUMN, PAGE

WALK = make_gait("walk", frames=20)
PAIR = Skeleton.preset("pair17")
POSES = synthetic_dances(1)[0].positions[::20]
POINTS = np.random.default_rng(0).normal(size=(25, 2))
KINDS = ["real"] * 24 + ["seed"]
COVERAGE = pd.DataFrame(
    [("interaction", "prior", 100, 0.3)], columns=["measure", "density", "draws", "coverage"]
)
ERRORS = pd.DataFrame(
    [("V = 5", "spread", part, 0.3, 0.1, 0.5) for part in ("guidance", "whole")],
    columns=["setting", "measure", "part", "mean", "low", "high"],
)
GENERATION = pd.DataFrame({"name": ["MAS"], "fid": [5.0]})
QUALITY = pd.DataFrame(
    [("gait", "mas", 0, name, 2.0) for name in ("seconds", "swd_ratio")],
    columns=["problem", "sampler", "seed", "metric", "value"],
)
LEVELS = {"real": {"prior": np.arange(9.0)}, "seed": {"prior": np.ones(1)}}
RANKS = {"exact": {"speed": np.linspace(0, 1, 50)}}


@pytest.mark.parametrize(
    ("draw", "arguments"),
    [
        (draw_calibration, (LEVELS,)),
        (draw_coverage, (COVERAGE,)),
        (draw_embedding, (POINTS, KINDS)),
        (draw_error_decomposition, (ERRORS,)),
        (draw_generation, (GENERATION, {"fid": "FID"})),
        (draw_pairs, ({"real": POSES}, PAIR)),
        (draw_ranks, (RANKS,)),
        (draw_skeletons, ({"walk": WALK.positions[None]}, WALK.skeleton)),
        (plot_spread, ({"mas": np.stack([WALK.positions, 1.1 * WALK.positions])}, WALK.skeleton)),
        (plot_quality_against_cost, (QUALITY,)),
    ],
)
def test_figures_are_written_as_png_pdf_and_svg(draw, arguments, tmp_path):
    begins = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
    for suffix, begin in begins.items():
        path = tmp_path / f"figure.{suffix}"
        width = draw(*arguments, path).get_size_inches()[0]
        content = path.read_bytes()
        assert content.startswith(begin)
        assert width in (COLUMN, PAGE)
    # The last figure is written again, later and by another object.
    draw(*arguments, tmp_path / "again.svg")
    assert (tmp_path / "again.svg").read_bytes() == content
    with pytest.raises(OSError, match="cannot write"):
        draw(*arguments, tmp_path / "missing" / "figure.png")
    with pytest.raises(ValueError, match=r"path must end in \.png, \.pdf or \.svg, got '.*jpg'"):
        draw(*arguments, tmp_path / "figure.jpg")
    assert len(list(tmp_path.iterdir())) == 4


def test_pdf_files_are_equal_and_embed_truetype_fonts(tmp_path):
    for name in ("one.pdf", "two.pdf"):
        draw_generation(GENERATION, {"fid": "FID"}, tmp_path / name)
    content = (tmp_path / "one.pdf").read_bytes()
    assert content == (tmp_path / "two.pdf").read_bytes()
    assert b"/FontFile2" in content
    assert b"/Type3" not in content
    assert b"CreationDate" not in content


NAN = np.full((1, 2, 17, 3), np.nan)
ONE_NAN = np.where(np.arange(34)[:, None] == 2, np.nan, POSES)
NOBODY = np.full((1, 34, 2), np.nan)
TWO_SETTINGS = pd.concat([ERRORS, ERRORS.assign(setting="V = 12")])


@pytest.mark.parametrize(
    ("draw", "arguments", "message"),
    [
        (draw_calibration, ({},), "levels must contain at least one kind of pose, got none"),
        (draw_calibration, (LEVELS | {"draws": {"b": [1]}},), r"must have the terms \['prior'\], "),
        (classical_scaling, (np.zeros((3, 4)),), r"distances must have shape \(3, 3\), got \(3,"),
        (classical_scaling, (np.zeros((1, 1)),), "must be between at least dim=2 points, got 1"),
        (draw_embedding, (POINTS, ["truth", *KINDS[1:]]), "kinds must be real, prior, .*got truth"),
        (draw_embedding, (POINTS, KINDS[1:]), r"kinds must have shape \(25\), got \(24,\)"),
        (draw_coverage, (COVERAGE.drop(columns="coverage"),), "got no columns coverage"),
        (draw_coverage, (COVERAGE[:0],), "table must have rows with measure, .* got no row"),
        (draw_coverage, (COVERAGE.assign(draws=0),), "draws in table must be at least 1, got 0"),
        (draw_error_decomposition, (ERRORS.drop(columns=["low"]),), "got no columns low"),
        (draw_error_decomposition, (TWO_SETTINGS,), "table must have one setting, got 2"),
        (draw_generation, (GENERATION, {"speed": "speed"}), "got no columns speed"),
        (draw_generation, (GENERATION[:0], {"fid": "FID"}), "table must have rows .*, got no row"),
        (draw_pairs, ({}, PAIR), "rows must contain at least one label with pose-pairs, got none"),
        (draw_pairs, ({"a": POSES[:, :17]}, PAIR), r"rows\['a'\] must have shape .* \(5, 17, 3\)"),
        (draw_pairs, ({"a": POSES[:0]}, PAIR), r"rows\['a'\] must contain at least one pose-pair"),
        (draw_pairs, ({"a": ONE_NAN}, PAIR), r"rows\['a'\] must be finite, got 15 values"),
        (draw_pairs, ({"a": NOBODY}, PAIR), r"rows\['a'\]\[0\] must have at least one visible j"),
        (draw_ranks, ({},), "blocks must contain at least one sampler with ranks, got none"),
        (draw_ranks, ({"mas": {}},), r"blocks\['mas'\] must contain at least one quantity"),
        (draw_ranks, ({"mas": {"speed": POINTS}},), r"\['speed'\] must have shape \(n\), got \(25"),
        (draw_skeletons, ({}, WALK.skeleton), "rows must contain at least one label with motions"),
        (draw_skeletons, ({"a": POSES}, WALK.skeleton), r"rows\['a'\] must have shape"),
        (draw_skeletons, ({"a": NAN}, WALK.skeleton), r"rows\['a'\] must be finite, got 102 val"),
        (plot_spread, ({"a": WALK.positions[None]}, WALK.skeleton), "at least two draws, got one"),
        (plot_quality_against_cost, (QUALITY[:1],), "table must have a sampler with a headline"),
    ],
)
def test_invalid_arguments_raise(draw, arguments, message):
    with pytest.raises(ValueError, match=message):
        draw(*arguments)

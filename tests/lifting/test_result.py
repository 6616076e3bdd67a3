import json

import numpy as np
import pytest

from probmotion.io.files import load


def test_a_lift_is_saved(lifted, tmp_path):
    lifted.save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "lift.bvh", "lift.glb", "lift.html", "lift.npz", "summary.json",
    ]  # fmt: skip
    content = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert content["trusted"] == lifted.trusted
    with np.load(tmp_path / "lift.npz", allow_pickle=False) as archive:
        assert np.allclose(archive["draws"], lifted.draws)
        assert np.allclose(archive["sd"], lifted.sd)
    assert np.allclose(load(tmp_path / "lift.npz").positions, lifted.mean.positions)


def test_the_page_loads_nothing_and_escapes_names(lifted, tmp_path):
    from dataclasses import replace

    named = replace(lifted, mean=replace(lifted.mean, name="<script>alert(1)</script>"))
    text = named.report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "default-src 'none'" in text
    assert lifted.summary()[1] in text


def test_other_suffixes_are_refused(lifted, tmp_path):
    with pytest.raises(ValueError, match="end in"):
        lifted.report(tmp_path / "page.txt")

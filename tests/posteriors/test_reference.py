"""Stored references: replaced as a whole, whenever the process is killed."""

from __future__ import annotations

import json
import os
import shutil
from itertools import count

import numpy as np
import pytest

from probmotion.posteriors.reference import StoredReference

CERTIFICATE = {
    "problem": "toy", "exact": False, "sampler": "nuts", "settings": {}, "rhat": 1.0,
    "agreement": [1.0], "fingerprint": [1.0],
}  # fmt: skip


def made(seed: int) -> StoredReference:
    positions = np.random.default_rng(seed).normal(size=(4, 3, 2, 3)).astype(np.float32)
    return StoredReference(positions, CERTIFICATE | {"draws": 4, "seed": seed})


def is_same(one: StoredReference, other: StoredReference) -> bool:
    same_draws = np.array_equal(one.positions, other.positions)
    assert same_draws == (one.certificate == other.certificate), "draws of another certificate"
    return same_draws


@pytest.fixture
def moments(tmp_path, monkeypatch):
    """Folders as a kill would leave them: copies before and after each file is renamed."""
    copies, number = [], count()

    def copied():
        copies.append(tmp_path / "copies" / str(next(number)))
        shutil.copytree(tmp_path / "work", copies[-1])

    def watched(rename):
        def function(source, target, **options):
            copied()
            rename(source, target, **options)
            copied()

        return function

    for name in ("rename", "replace"):
        monkeypatch.setattr(os, name, watched(getattr(os, name)))
    return copies


def test_a_killed_process_leaves_the_earlier_or_the_new_reference(tmp_path, moments):
    folder, old, new = tmp_path / "work" / "toy", made(0), made(1)
    old.save(folder)
    moments.clear()
    new.save(folder)
    kinds = [is_same(StoredReference.load(copy / "toy"), new) for copy in moments]
    assert kinds == sorted(kinds)
    assert (kinds[0], kinds[-1]) == (False, True)
    for copy, is_new in list(zip(moments, kinds, strict=True)):
        assert is_new or is_same(StoredReference.load(copy / "toy"), old)
        # Written again, it is like one that was never interrupted.
        new.save(copy / "toy")
        assert is_same(StoredReference.load(copy / "toy"), new)
        names = {path.name for path in (copy / "toy").iterdir()}
        assert names == {"certificate.json", "draws.npz"}


def test_a_killed_process_leaves_no_part_of_a_first_reference(tmp_path, moments):
    made(0).save(tmp_path / "work" / "toy")
    for copy in moments:
        # A folder without a certificate is none of a reference.
        if (copy / "toy" / "certificate.json").exists():
            assert is_same(StoredReference.load(copy / "toy"), made(0))


def test_draws_of_another_certificate_are_refused(tmp_path):
    folders = [made(seed).save(tmp_path / str(seed)) for seed in (0, 1)]
    shutil.copy(folders[0] / "draws.npz", folders[1])
    with pytest.raises(ValueError, match=r"must contain draws.npz .*checksum of draws.npz is not"):
        StoredReference.load(folders[1])


def test_references_of_earlier_versions_have_no_checksum(tmp_path):
    folder = made(0).save(tmp_path / "toy")
    certificate = json.loads((folder / "certificate.json").read_text())
    del certificate["draws_crc32"], certificate["crc32"]
    (folder / "certificate.json").write_text(json.dumps(certificate))
    assert is_same(StoredReference.load(folder), made(0))
    # The earlier reference is loaded until the certificate is replaced.
    shutil.copy(made(1).save(tmp_path / "new") / "draws.npz", folder / ".new.npz")
    assert is_same(StoredReference.load(folder), made(0))

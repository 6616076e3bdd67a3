"""Fixtures of the tests of 2D tracks."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def write_archive():
    """Write a track to ``<name>.npz`` and return its path."""

    def write(track, folder, name="archive"):
        path = folder / f"{name}.npz"
        np.savez(
            path,
            keypoints=track.keypoints,
            confidence=track.confidence,
            fps=track.fps,
            joint_names=np.array(track.skeleton.joint_names),
            parents=np.array(track.skeleton.parents, dtype=np.int32),
        )
        return path

    return write

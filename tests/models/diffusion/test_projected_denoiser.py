"""2D denoiser trained on projections of draws of a prior, and its use in MAS."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import MotionPosterior, Skeleton
from probmotion.models.diffusion.projected_denoiser import denoiser_of
from probmotion.models.training.settings import TrainingSettings
from probmotion.samplers import MultiViewAncestral

ARM = Skeleton(["pelvis", "neck", "left_shoulder", "right_shoulder"], [-1, 0, 1, 1])
REST = np.array([[0, 0, 0], [0, 0.5, 0], [0.2, 0, 0], [-0.2, 0, 0]])
TRAINING = TrainingSettings(steps=60, batch=32, learning_rate=5e-3, warmup=5, ema=0.9)


class Arms:
    """Prior over a body at rest with a random heading."""

    skeleton, frames, fps, dim = ARM, 4, 20.0, 48

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 4, 4, 3)

    def sample(self, rng, n):
        rotations = Rotation.from_rotvec(rng.uniform(0, 6, (n, 1)) * [0.0, 1.0, 0.0]).as_matrix()
        poses = REST + 0.02 * rng.standard_normal((n, 4, 4, 3))
        return (poses - poses[:, :, :1]) @ rotations[:, None]


def learn(prior, out, **options):
    settings = {"size": "tiny", "motions": 20, "views": 4, "training": TRAINING} | options
    return denoiser_of(prior, out, progress=False, **settings)


def test_learnt_denoisers_are_used_by_mas_and_training_resumes(tmp_path):
    denoiser = learn(Arms(), tmp_path)
    assert (denoiser.skeleton, denoiser.frames, denoiser.fps) == (ARM, 4, 20.0)
    clips = [set(denoiser.card["network"][data]["clips"]) for data in ("data", "validation_data")]
    assert [len(names) for names in clips] == [18, 2]
    assert not clips[0] & clips[1]
    draws = MultiViewAncestral(steps=20).sample(
        MotionPosterior(denoiser), draws=8, seed=0, progress=False
    )
    assert draws.positions.shape == (1, 8, 4, 4, 3)
    trunk = np.linalg.norm(draws.positions[..., 1, :] - draws.positions[..., 0, :], axis=-1)
    assert 0.4 < np.median(trunk) < 0.6
    assert learn(Arms(), tmp_path).card == denoiser.card
    with pytest.raises(ValueError, match="mean must be the same to resume"):
        learn(Arms(), tmp_path, seed=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"motions": 1}, "motions must be an integer of at least 2, got 1"),
        ({"views": 0}, "views must be an integer of at least 1, got 0"),
        ({"size": "large"}, "size must be one of tiny, small, paper, got 'large'"),
    ],
)
def test_invalid_options_are_rejected(tmp_path, options, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        learn(Arms(), tmp_path, **options)
    with pytest.raises(ValueError, match="prior must have a sample method, got object"):
        learn(object(), tmp_path)

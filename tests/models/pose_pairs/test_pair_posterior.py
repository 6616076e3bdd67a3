"""Posterior of pose-pairs end to end, from files to draws."""

from __future__ import annotations

import json

import numpy as np
import pytest

from probmotion.data.pair_sets import choose_seed
from probmotion.data.pairs import pair_motion
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.tracks import annotations_of_tracks
from probmotion.io.files import load, read_keypoints, save
from probmotion.models.pose_pairs.joint_limits_learning import learn_limits
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.draws import MotionDraws
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic, VelocityBiased

ONE = Skeleton.preset("person17")
FEW = PairSettings(n_views=4, n_near=8)
DANCE = synthetic_dances(1)[0]
SEED = DANCE.positions[choose_seed(DANCE.positions)]


@pytest.fixture(scope="module")
def posterior():
    return pair_posterior(SEED, draw_annotations([DANCE], 40, seed=0).annotations, FEW)


def run(posterior, proposal=None, **settings):
    sampler = MetropolisHastings(proposal or Isotropic(0.02), warmup=30, thin=1, **settings)
    return sampler.sample(posterior, draws=10, chains=2, progress=False)


def write_openpose(folder, dance):
    """Write one BODY_25 file per frame, without the second person in three frames."""
    middle = {"8": "pelvis", "0": "head", "1": "neck"}
    sides = {
        f"{first + at}": f"{side}_{part}"
        for side, arm, leg in (("right", 2, 9), ("left", 5, 12))
        for first, parts in ((arm, ("shoulder", "elbow", "wrist")), (leg, ("hip", "knee", "ankle")))
        for at, part in enumerate(parts)
    }
    for frame, pose in enumerate(dance.positions):
        people = []
        for person in range(2):
            rows = np.zeros((25, 3))
            for place, name in (middle | sides).items():
                joint = pose[dance.skeleton.index(f"person{person}:{name}")]
                rows[int(place)] = [900 + 400 * joint[0], 1000 - 400 * joint[1], 0.9]
            if person == 0 or frame not in (10, 11, 12):
                people.append({"pose_keypoints_2d": rows.ravel().tolist()})
        path = folder / f"video_{frame:012d}_keypoints.json"
        path.write_text(json.dumps({"version": 1.3, "people": people}))


def test_keypoint_json_to_draws(tmp_path):
    write_openpose(tmp_path, DANCE)
    annotations = annotations_of_tracks(read_keypoints(tmp_path, 30.0, "body25", people=2), SEED)
    assert len(annotations) == DANCE.frames - 3
    assert "frames dropped: 3" in annotations.describe()
    # The scale is estimated.
    spread = np.ptp(annotations.keypoints[..., 1], axis=1)
    assert np.abs(spread / np.ptp(DANCE.positions[0, :, 1]) - 1).max() < 0.25
    draws = run(pair_posterior(SEED, annotations, FEW))
    assert draws.fps == 30
    assert np.isfinite(draws.dataset["log_density"].values).all()


def test_two_bvh_files_to_draws(tmp_path):
    for person in range(2):
        joints = [DANCE.skeleton.index(f"person{person}:{name}") for name in ONE.joint_names]
        alone = Motion(DANCE.positions[:, joints], ONE, 30.0)
        save(alone, tmp_path / f"dancer{person}.bvh")
    pair = pair_motion(*(load(tmp_path / f"dancer{k}.bvh") for k in range(2)))
    assert np.abs(pair.positions - DANCE.positions).max() < 1e-5
    annotations = draw_annotations([pair], 30, seed=0).annotations
    assert run(pair_posterior(SEED, annotations, FEW)).positions.shape == (2, 10, 1, 34, 3)


def test_draws_are_saved_and_continued(tmp_path, posterior):
    draws = run(posterior, VelocityBiased(scale=0.3))
    draws.save(tmp_path / "draws.nc")
    loaded = MotionDraws.load(tmp_path / "draws.nc")
    assert loaded.skeleton == DANCE.skeleton
    assert np.array_equal(loaded.playback(chain=1).positions, draws.positions.values[1, :, 0])
    start = loaded.dataset["theta"].values[:, 7]
    sampler = MetropolisHastings(Isotropic(1e-9, None), warmup=0, thin=1)
    first = sampler.sample(posterior, draws=1, chains=2, initial=start, progress=False)
    assert np.allclose(first.positions.values[:, 0], loaded.positions.values[:, 7], atol=1e-6)


def test_pseudo_marginal_chains_use_fresh_views(posterior):
    fixed = posterior.likelihood.views.copy()
    draws = run(posterior, pseudo_marginal=True)
    assert np.array_equal(posterior.likelihood.views, fixed)
    with_fixed_views = posterior.log_density(draws.dataset["theta"].values)
    assert np.abs(with_fixed_views - draws.dataset["log_density"].values).max() > 0.1
    assert np.array_equal(run(posterior, pseudo_marginal=True).flat(), draws.flat())
    citations = " ".join(draws.citations())
    assert "Andrieu, Roberts" in citations
    assert "3D pose-pairs from 2D annotations" in citations
    assert "Andrieu" not in " ".join(run(posterior).citations())


def test_unusual_rig_needs_its_own_limits():
    """Hips far below the pelvis, unlike the clips of the shipped limits."""
    unusual = DANCE.positions.copy()
    parts = ("hip", "knee", "ankle")
    legs = [k for k, name in enumerate(DANCE.skeleton.joint_names) if name.endswith(parts)]
    unusual[:, legs] -= [0.0, 0.25, 0.0]
    motion = Motion(unusual, DANCE.skeleton, 30.0)
    annotations = draw_annotations([motion], 30, seed=0).annotations
    settings = PairSettings(n_views=4, n_near=8, max_invalid=1)
    with pytest.raises(ValueError, match=r"seed 0 must have at most 1 joint angles .*left_hip"):
        pair_posterior(unusual[0], annotations, settings)
    limits = learn_limits([unusual[:, :17], unusual[:, 17:]])
    posterior = pair_posterior(unusual[0], annotations, settings, limits=limits)
    assert posterior.prior.invalid_joints(unusual[0]) == []

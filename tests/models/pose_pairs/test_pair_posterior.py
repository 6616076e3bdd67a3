"""From files of two people to draws: each way in that a user has."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from probmotion.data.pair_sets import choose_seed
from probmotion.data.pairs import pair_motion
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.tracks import annotations_of_tracks
from probmotion.io.files import load_motion, read_keypoints, save_motion
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


def run(posterior, proposal=None, **settings) -> MotionDraws:
    sampler = MetropolisHastings(proposal or Isotropic(0.02), warmup=100, thin=1, **settings)
    return sampler.sample(posterior, draws=20, chains=2, progress=False)


def openpose(folder: Path, dance: Motion) -> None:
    """Write a video's detections, one BODY_25 file a frame, the second person lost in three."""
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


def test_from_keypoint_json_of_a_video_to_draws(tmp_path):
    openpose(tmp_path, DANCE)
    annotations = annotations_of_tracks(read_keypoints(tmp_path, 30.0, "body25", people=2), SEED)
    assert len(annotations) == DANCE.frames - 3
    assert "frames dropped: 3" in annotations.describe()
    # Pixels became metres, without being told their size.
    spread = np.ptp(annotations.keypoints[..., 1], axis=1)
    assert np.abs(spread / np.ptp(DANCE.positions[0, :, 1]) - 1).max() < 0.25
    draws = run(pair_posterior(SEED, annotations, FEW))
    assert draws.fps == 30
    assert np.isfinite(draws.dataset["log_density"].values).all()


def test_from_two_bvh_files_to_draws(tmp_path):
    for person in range(2):
        joints = [DANCE.skeleton.index(f"person{person}:{name}") for name in ONE.joint_names]
        alone = Motion(DANCE.positions[:, joints], ONE, 30.0)
        save_motion(alone, tmp_path / f"dancer{person}.bvh")
    pair = pair_motion(*(load_motion(tmp_path / f"dancer{k}.bvh") for k in range(2)))
    assert np.abs(pair.positions - DANCE.positions).max() < 1e-5
    annotations = draw_annotations([pair], 30, seed=0).annotations
    assert run(pair_posterior(SEED, annotations, FEW)).positions.shape == (2, 20, 1, 34, 3)


def test_draws_are_saved_played_and_started_from(tmp_path):
    posterior = pair_posterior(SEED, draw_annotations([DANCE], 40, seed=0).annotations, FEW)
    draws = run(posterior, VelocityBiased(scale=0.3))
    draws.save(tmp_path / "draws.nc")
    kept = MotionDraws.load(tmp_path / "draws.nc")
    assert kept.skeleton == DANCE.skeleton
    walk = kept.playback(chain=1)
    assert np.array_equal(walk.positions, draws.positions.values[1, :, 0])
    liked = kept.dataset["theta"].values[:, 7]
    again = MetropolisHastings(Isotropic(1e-9, None), warmup=0, thin=1)
    first = again.sample(posterior, draws=1, chains=2, initial=liked, progress=False)
    assert np.allclose(first.positions.values[:, 0], kept.positions.values[:, 7], atol=1e-6)


def test_fresh_views_are_an_option_and_the_fixed_ones_are_not_touched():
    posterior = pair_posterior(SEED, draw_annotations([DANCE], 40, seed=0).annotations, FEW)
    fixed = posterior.likelihood.views.copy()
    draws = run(posterior, pseudo_marginal=True)
    assert np.array_equal(posterior.likelihood.views, fixed)
    again = posterior.log_density(draws.dataset["theta"].values)
    # Estimates are kept as they were, and are not those of the fixed views.
    assert np.abs(again - draws.dataset["log_density"].values).max() > 0.1
    assert np.array_equal(run(posterior, pseudo_marginal=True).flat(), draws.flat())
    cited = " ".join(draws.citations())
    assert "Andrieu, Roberts" in cited
    assert "3D pose-pairs from 2D annotations" in cited
    assert "Andrieu" not in " ".join(run(posterior).citations())


def test_several_seeds_run_several_chains():
    poses = DANCE.positions[[0, 30, 60]]
    annotations = draw_annotations([DANCE], 40, seed=0).annotations
    posterior = pair_posterior(poses, annotations, FEW)
    start = posterior.prior.coordinates(poses)
    sampler = MetropolisHastings(Isotropic(1e-3, None), warmup=0, thin=1)
    draws = sampler.sample(posterior, draws=3, chains=3, initial=start, progress=False)
    assert np.abs(draws.positions.values[:, -1, 0] - poses).max() < 0.05


def test_a_rig_of_another_kind_needs_limits_of_its_own():
    """Hips far below the pelvis, as no clip of the shipped table has them."""

    other = DANCE.positions.copy()
    for person in ("person0", "person1"):
        legs = [
            DANCE.skeleton.index(f"{person}:{side}_{part}")
            for side in ("left", "right")
            for part in ("hip", "knee", "ankle")
        ]
        other[:, legs] -= [0.0, 0.25, 0.0]
    annotations = draw_annotations([Motion(other, DANCE.skeleton, 30.0)], 30, seed=0).annotations
    settings = PairSettings(n_views=4, n_near=8, max_invalid=1)
    with pytest.raises(
        ValueError, match=r"seed 0 has .* joint angles beyond the limits .*left_hip"
    ):
        pair_posterior(other[0], annotations, settings)
    learnt = learn_limits([other[:, :17], other[:, 17:]])
    posterior = pair_posterior(other[0], annotations, settings, limits=learnt)
    assert posterior.prior.invalid_joints(other[0]) == []

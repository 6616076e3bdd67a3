"""A problem from clips: one is held out for good, and every mistake is one sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import load_motions
from probmotion.problems import clips_problem, load_problem
from probmotion.problems.clips import CLIP_PROBLEMS

DATA = Path(__file__).parents[3] / "shared" / "data"
SMALL = {"frames": 10, "rank": 3, "styles": 2}


def gaits(n=6, frames=60):
    return [make_gait("walk", i, frames=frames) for i in range(n // 2)] + [
        make_gait("run", i, frames=frames) for i in range(n - n // 2)
    ]


def test_nothing_of_the_held_out_clip_is_in_the_prior():
    clips = gaits()
    other = Motion(5 * clips[-1].positions[::-1], clips[-1].skeleton, 30.0, name="other")
    one = clips_problem(clips, **SMALL).posterior.prior
    two = clips_problem([*clips[:-1], other], **SMALL).posterior.prior
    three = clips_problem([*clips[1:], clips[0]], **SMALL).posterior.prior
    for name in ("means", "factors", "weights"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert (one.means != three.means).any()


def test_the_truth_is_the_held_out_clips_middle_window_centred():
    clips = gaits()
    problem = clips_problem(clips, held_out="walk-1", noise=0.01, **SMALL)
    window = clips[1].positions[25:35]
    np.testing.assert_allclose(problem.truth, window - window[:, 0].mean(axis=0), atol=1e-12)
    evidence = problem.posterior.likelihood
    residual = evidence.keypoints - evidence.cameras.project(problem.truth)
    assert abs(residual.std() / 0.01 - 1) < 0.2
    assert "walk-1" in problem.description


@pytest.mark.parametrize("how", ["monocular", "occluded", "sparse"])
def test_what_is_observed_is_chosen_by_name(how):
    seen = clips_problem(gaits(), observe=how, **SMALL).posterior.likelihood.entries.visible
    assert {"monocular": 170, "occluded": 170 - 15, "sparse": 6}[how] == seen.sum()


def test_without_evidence_there_is_no_truth():
    problem = clips_problem(gaits(), observe="none", **SMALL)
    assert problem.posterior.likelihood is None
    assert problem.truth is None


def test_clips_of_several_frame_rates_are_resampled_on_request_alone():
    clips = [*gaits(), make_gait("run", 9, frames=90, fps=60.0)]
    with pytest.raises(ValueError, match=r"clips of 30, 60 frames per second.*give fps="):
        clips_problem(clips, **SMALL)
    problem = clips_problem(clips, fps=30.0, **SMALL)
    assert problem.posterior.fps == 30.0
    assert problem.truth.shape == (10, 17, 3)


def test_clips_of_several_skeletons_meet_on_their_common_joints():
    clips = gaits()
    kept = [joint for joint in range(17) if clips[0].skeleton.joint_names[joint] != "head"]
    bald = replace(
        clips[0], skeleton=clips[0].skeleton.subset(kept), positions=clips[0].positions[:, kept]
    )
    problem = clips_problem([bald, *clips[1:]], **SMALL)
    assert problem.posterior.skeleton.n_joints == 16
    assert "head" not in problem.posterior.skeleton.joint_names


def test_clips_that_are_too_short_are_left_out_and_said_so():
    problem = clips_problem([gaits()[0].window(0, 5), *gaits()], **SMALL)
    assert "(1 shorter than 10 frames left out)" in problem.description


@pytest.mark.parametrize(
    ("clips", "settings", "sentence"),
    [
        (gaits()[:1], {}, "motions has 1 clip, expected at least 2"),
        ([], {}, "motions has 0 clips, expected at least 2"),
        (gaits(), {"frames": 61}, r"held_out is .* expected a clip of at least frames=61"),
        (
            [*gaits(frames=20), gaits()[0]],
            {"frames": 30},
            "motions has at most 20 frames in the clips that are not held out",
        ),
        (gaits(), {"held_out": "jump"}, "held_out is 'jump', which names 0 clips, expected one of"),
        (gaits(), {"held_out": 6}, "held_out must be an index into the 6 clips, got 6"),
        (gaits(), {"observe": "sound"}, "observe must be one of none, monocular, got 'sound'"),
        (gaits(), {"noise": 0.0}, "noise must be a finite number above 0, got 0.0"),
        (gaits(), {"rank": 500}, "give more or longer clips, fewer styles or a lower rank"),
    ],
)
def test_every_mistake_is_one_sentence(clips, settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        clips_problem(clips, **(SMALL | settings))


@pytest.mark.skipif(not DATA.exists(), reason="the real clips are not beside this checkout")
def test_real_bvh_files_make_a_problem():
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the reader guesses one file's unit and says so
        clips = load_motions(DATA / "originals" / "*.bvh", fps=30.0)
    problem = clips_problem(clips)
    draws = problem.reference(0, 50)
    image = problem.posterior.likelihood.cameras.project(draws)
    assert np.abs(image - problem.posterior.likelihood.keypoints).mean() < 0.1


def test_a_clip_that_is_there_twice_is_refused():
    clips = [make_gait("walk", number, frames=40) for number in range(4)]
    with pytest.raises(ValueError, match=r"twice \(as walk-3 and walk-3\), expected"):
        clips_problem([*clips, clips[-1]])


def test_clips_that_do_not_move_are_refused_in_one_sentence():
    clip = make_gait("walk", 0, frames=200)
    still = replace(clip, positions=np.repeat(clip.positions[:1], 200, axis=0))
    with pytest.raises(ValueError, match="windows that are all alike, expected clips that differ"):
        clips_problem([still, clip])


def test_it_can_be_simulated_and_so_calibrated():
    problem = clips_problem(gaits(), **SMALL)
    again = problem.simulate(3)
    assert again.truth.shape == problem.truth.shape
    assert not np.allclose(again.truth, problem.truth)
    np.testing.assert_array_equal(again.truth, problem.simulate(3).truth)
    # Its evidence is of its own truth, through the same camera.
    off = again.posterior.likelihood.keypoints - again.posterior.likelihood.cameras.project(
        again.truth
    )
    assert np.sqrt((off**2).mean()) == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize(("name", "sees"), [("cmu", False), ("cmu-monocular", True)])
def test_cmu_s_clips_make_an_exact_problem(real_data, name, sees):
    problem = load_problem(name)
    assert problem.exact is not None
    assert (problem.truth is not None) == sees
    assert problem.simulate is not None
    walks = problem.posterior.prior
    assert walks.frames == 30
    if sees:
        # What one camera saw says a good part, of a walk that nothing was learnt from.
        known = problem.reference(0, 50)
        believed = problem.posterior.prior.sample(np.random.default_rng(0), 50)
        far, near = (
            np.linalg.norm(drawn - drawn[:, :, :1] - problem.truth + problem.truth[:, :1], axis=-1)
            for drawn in (believed, known)
        )
        assert near.mean() < 0.6 * far.mean()


def test_without_cmu_s_clips_the_way_to_get_them_is_said(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="the clip cmu_02_01 is not in"):
        CLIP_PROBLEMS["cmu"][1]()

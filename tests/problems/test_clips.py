"""Problems from clips: held-out data, preprocessing and input errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Motion
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import load_all
from probmotion.problems import clips_problem, load_problem

SMALL = {"frames": 10, "rank": 3, "styles": 2}


def gaits(n=6, frames=60):
    return [make_gait("walk", i, frames=frames) for i in range(n // 2)] + [
        make_gait("run", i, frames=frames) for i in range(n - n // 2)
    ]


def test_prior_does_not_depend_on_the_held_out_clip():
    clips = gaits()
    other = Motion(5 * clips[-1].positions[::-1], clips[-1].skeleton, 30.0, name="other")
    first = clips_problem(clips, **SMALL).posterior.prior
    second = clips_problem([*clips[:-1], other], **SMALL).posterior.prior
    third = clips_problem([*clips[1:], clips[0]], **SMALL).posterior.prior
    for name in ("means", "factors", "weights"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert (first.means != third.means).any()


def test_truth_is_the_centred_middle_window():
    clips = gaits()
    problem = clips_problem(clips, held_out="walk-1", noise=0.01, **SMALL)
    window = clips[1].positions[25:35]
    np.testing.assert_allclose(problem.truth, window - window[:, 0].mean(axis=0), atol=1e-12)
    likelihood = problem.posterior.likelihood
    residual = likelihood.keypoints - likelihood.cameras.project(problem.truth)
    assert abs(residual.std() / 0.01 - 1) < 0.2
    assert "walk-1" in problem.description


@pytest.mark.parametrize("how", ["none", "monocular", "occluded", "sparse"])
def test_observations_are_selected_by_name(how):
    problem = clips_problem(gaits(), observe=how, **SMALL)
    likelihood = problem.posterior.likelihood
    assert (problem.truth is None) == (likelihood is None) == (how == "none")
    if how != "none":
        visible = likelihood.entries.visible.sum()
        assert {"monocular": 170, "occluded": 170 - 15, "sparse": 6}[how] == visible


def test_clips_are_resampled_on_request_only():
    clips = [*gaits(), make_gait("run", 9, frames=90, fps=60.0)]
    with pytest.raises(ValueError, match=r"got 30, 60 frames per second; set fps="):
        clips_problem(clips, **SMALL)
    problem = clips_problem(clips, fps=30.0, **SMALL)
    assert problem.posterior.fps == 30.0
    assert problem.truth.shape == (10, 17, 3)


def test_common_joints_are_used_and_short_clips_are_reported():
    clips = gaits()
    skeleton = clips[0].skeleton
    others = [joint for joint in range(17) if skeleton.joint_names[joint] != "head"]
    positions = clips[0].positions[:5, others]
    headless = replace(clips[0], skeleton=skeleton.subset(others), positions=positions)
    problem = clips_problem([headless, *clips[1:]], **SMALL)
    assert problem.posterior.skeleton.joint_names == headless.skeleton.joint_names
    assert "(1 shorter than 10 frames left out)" in problem.description


STATIC = replace(gaits()[0], positions=np.repeat(gaits()[0].positions[:1], 60, axis=0))


@pytest.mark.parametrize(
    ("clips", "settings", "message"),
    [
        (gaits()[:1], {}, "motions must contain at least 2 clips, .* got 1"),
        ([*gaits(), gaits()[-1]], {}, r"motions must be distinct, .* twice \(as run-2 and run-2\)"),
        ([STATIC, gaits()[0]], {}, "motions must contain different windows"),
        (gaits(), {"frames": 61}, "held_out must be a clip of at least frames=61"),
        (
            [*gaits(frames=20), gaits()[0]],
            {"frames": 30},
            "besides the held-out one, got at most 2",
        ),
        (gaits(), {"held_out": "jump"}, "held_out must name exactly one of walk-0, .* got 'jump'"),
        (gaits(), {"held_out": 6}, "held_out must be an index into the 6 clips, got 6"),
        (gaits(), {"observe": "sound"}, "observe must be one of none, monocular, .* got 'sound'"),
        (gaits(), {"noise": 0.0}, "noise must be a finite number above 0, got 0.0"),
        (gaits(), {"rank": 500}, "use more or longer clips, fewer styles or a lower rank"),
    ],
)
def test_invalid_arguments_are_rejected(clips, settings, message):
    with pytest.raises(ValueError, match=message):
        clips_problem(clips, **(SMALL | settings))


@pytest.mark.filterwarnings("ignore")  # the unit of one file is guessed
def test_problem_from_real_bvh_files(real_data):
    problem = clips_problem(load_all(real_data / "originals" / "*.bvh", fps=30.0))
    likelihood = problem.posterior.likelihood
    image = likelihood.cameras.project(problem.reference(0, 50))
    assert np.abs(image - likelihood.keypoints).mean() < 0.1


def test_cmu_problems_are_exact(real_data):
    problem = load_problem("cmu-monocular")
    prior = problem.posterior.prior
    assert prior.frames == 30
    # The observations reduce the error for a clip that was held out.
    centred = problem.truth - problem.truth[:, :1]
    prior_error, error = (
        np.linalg.norm(drawn - drawn[:, :, :1] - centred, axis=-1).mean()
        for drawn in (prior.sample(np.random.default_rng(0), 50), problem.reference(0, 50))
    )
    assert error < 0.6 * prior_error

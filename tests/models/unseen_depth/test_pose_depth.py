import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.lifting.keypoints import averaged, body_path, from_hips, person_keypoints
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.unseen_depth.pose_depth import (
    FRAMES,
    INPUTS,
    KEYPOINTS,
    RATE,
    PoseDepth,
    network_inputs,
    relative_keypoints,
)
from probmotion.models.unseen_depth.pose_depth_training import (
    DepthExamples,
    PoseDepthTrainee,
    regression,
)
from probmotion.motion.skeleton import Skeleton

torch = pytest.importorskip("torch")

J = len(KEYPOINTS)
PERSON = Skeleton.preset("person14")
MIRRORED = [KEYPOINTS.index(PERSON.mirrored_order[j]) for j in KEYPOINTS]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def network(rng):
    sizes = [INPUTS, 16, 16, 2 * J + 2]
    return PoseDepth(
        [
            (0.1 * rng.normal(size=(o, i)), 0.1 * rng.normal(size=o))
            for i, o in itertools.pairwise(sizes)
        ],
        {},
    )


def keypoints(rng, frames=20):
    """Return points, visibility, middle and size."""
    points = rng.uniform(300, 700, (frames, J, 2))
    return points, rng.random((frames, J)) > 0.2, points.mean(axis=1), rng.uniform(150, 200, frames)


def test_mirrored_pictures_have_the_same_depths(network, rng):
    points, visible, middle, size = keypoints(rng)
    first = network.estimate(points, visible, middle, size, RATE)
    flip = np.array([-1.0, 1.0])
    other = network.estimate(
        points[:, MIRRORED] * flip, visible[:, MIRRORED], middle * flip, size, RATE
    )
    assert np.allclose(other.depth, first.depth[:, MIRRORED])
    assert np.allclose(other.spread, first.spread[:, MIRRORED])
    assert np.allclose(other.disagreement, first.disagreement[:, MIRRORED])
    assert np.allclose(other.pitch, first.pitch)
    assert np.abs(first.depth - first.depth[:, MIRRORED]).max() > 0.01


def test_estimates_that_do_not_depend_on_the_image_agree(network, rng):
    """An offset of one joint makes the estimates of it and of its counterpart differ."""
    *rest, (matrix, offset) = network.layers
    offset = np.zeros_like(offset)
    arguments = keypoints(rng)

    def disagreement(offset):
        layers = [*rest, (0 * matrix, offset)]
        return replace(network, layers=layers).estimate(*arguments, RATE).disagreement

    assert not disagreement(offset).any()
    offset[0] = 0.3
    found = disagreement(offset)
    assert np.allclose(found[:, [0, MIRRORED[0]]], 0.15)
    assert np.allclose(np.delete(found, [0, MIRRORED[0]], axis=1), 0)


def test_place_and_size_in_the_picture_and_unknown_points_do_not_matter(network, rng):
    points, visible, middle, size = keypoints(rng)
    first = network.estimate(points, visible, middle, size, RATE)
    moved = np.where(visible[..., None], 3 * points - 100, np.nan)
    other = network.estimate(moved, visible, 3 * middle - 100, 3 * size, RATE)
    assert np.allclose(other.depth, first.depth)
    assert np.allclose(other.pitch, first.pitch)


def test_inputs_span_the_same_time_at_other_rates(network, rng):
    points, visible, middle, size = keypoints(rng)
    first = network.estimate(points, visible, middle, size, RATE)
    twice = network.estimate(
        *(np.repeat(x, 2, axis=0) for x in (points, visible, middle, size)), 2 * RATE
    )
    assert np.allclose(twice.depth[::2], first.depth)


def test_inputs_contain_the_depths_along_shortened_bones(rng):
    windows = np.ones((1, FRAMES, 3 * J))
    points = windows[..., : 2 * J].reshape(FRAMES, J, 2)
    points[:] = rng.normal(size=points.shape)
    hip, knee, ankle = (
        KEYPOINTS.index(PERSON.joint_names.index(f"left_{name}"))
        for name in ("hip", "knee", "ankle")
    )
    # Thighs are 42 cm, shanks 41 cm long.
    points[:, knee] = points[:, hip] + [0.3, 0.0]
    points[:, ankle] = points[:, knee] + [0.0, -0.5]
    inputs = network_inputs(windows)[0, 3 * J * FRAMES :].reshape(2, FRAMES, -1)
    shorter, longer = inputs[:, 4]
    assert np.isclose(shorter, np.sqrt(0.42**2 - 0.3**2)).sum() == 1
    assert np.isclose(longer, np.sqrt(0.5**2 - 0.41**2)).sum() == 1
    assert (shorter * longer == 0).all()


def test_unknown_keypoints_are_interpolated_in_time(rng):
    points, known = rng.normal(size=(FRAMES, J, 2)), np.ones((FRAMES, J))
    known[[0, 3, 4, 8], 2] = 0.0
    known[:, 5] = 0.0
    hidden = np.where(known[..., None] > 0, points, 0.0).reshape(FRAMES, -1)
    inputs = network_inputs(np.concatenate([hidden, known], axis=1)[None])[0]
    filled = inputs[: 2 * J * FRAMES].reshape(FRAMES, J, 2)
    seen = np.array([1, 2, 5, 6, 7])
    for axis in range(2):
        expected = np.interp(np.arange(FRAMES), seen, points[seen, 2, axis])
        assert np.allclose(filled[:, 2, axis], expected)
    assert (filled[:, 5] == 0).all()
    others = [j for j in range(J) if j not in (2, 5)]
    assert np.allclose(filled[:, others], points[:, others])
    assert np.array_equal(inputs[2 * J * FRAMES : 3 * J * FRAMES], known.ravel())


def test_trained_weights_give_the_same_network(rng):
    inputs = rng.normal(size=(30, 3 * J))
    examples = DepthExamples([inputs], [np.zeros((30, J + 1))])
    trainee = PoseDepthTrainee(examples, examples, width=16)
    network = regression(trainee.network.state_dict(), {})
    rows = rng.normal(size=(5, INPUTS))
    with torch.no_grad():
        expected = trainee.network.eval()(torch.as_tensor(rows, dtype=torch.float32)).numpy()
    assert np.allclose(network._outputs(rows), expected, atol=1e-5)


def test_a_file_restores_the_network_in_half_precision(network, rng, tmp_path):
    network.save(tmp_path / "depth.npz")
    again = PoseDepth.load(tmp_path / "depth.npz")
    points, visible, middle, size = keypoints(rng)
    first, second = (n.estimate(points, visible, middle, size, RATE) for n in (network, again))
    assert np.allclose(first.depth, second.depth, atol=5e-3)
    assert np.abs(first.depth - second.depth).max() > 0


@pytest.mark.parametrize("change", ["layers", "narrow", "nan", "card", "text", "missing", "format"])
def test_other_files_are_refused(network, change, tmp_path):
    path = tmp_path / "depth.npz"
    layers = list(network.layers)
    if change == "layers":
        layers[1] = (np.zeros((16, 15)), np.zeros(16))
    if change == "narrow":
        layers[1] = (np.zeros((1, 16)), np.zeros(1))
    if change == "nan":
        layers[2] = (np.full_like(layers[2][0], np.nan), layers[2][1])
    replace(network, layers=layers).save(path)
    if change in ("card", "format"):
        with np.load(path) as archive:
            arrays = dict(archive)
        header = {"format": int(change == "card"), "card": None}
        np.savez(path, **arrays | {"header": np.array(json.dumps(header))})
    if change == "text":
        path.write_text("depth")
    if change == "missing":
        np.savez(path, matrix0=np.zeros((2, 2)))
    again = r".* learn it again: python notebooks/ship_pose_depth\.py" * (change == "format")
    with pytest.raises(ValueError, match=rf"PoseDepth\.save{again}"):
        PoseDepth.load(path)


def videos(styles, seeds):
    return [
        film(make_gait(style, seed, frames=90), seed, azimuth=seed * 1.3, height=0.8 + seed % 3)
        for style in styles
        for seed in seeds
    ]


def example(video):
    """Return the arguments of the estimate, the true depths and pitch."""
    seen = averaged(person_keypoints(video.track), 2)
    joints = list(KEYPOINTS)
    positions = video.motion.positions.reshape(-1, 2, 14, 3).mean(axis=1)
    pitch = -float(video.camera.elevation[0])
    depth = from_hips(positions)[:, joints] @ [0, np.sin(pitch), -np.cos(pitch)]
    arguments = seen.points[:, joints], seen.weight[:, joints] > 0, *body_path(seen)
    return arguments, depth, pitch


def test_training_learns_depths_of_gaits(tmp_path):
    parts = []
    for seeds in (range(1, 9), (11, 12)):
        rows = [example(video) for video in videos(("walk", "run"), seeds)]
        targets = [np.column_stack([d, np.full(len(d), p)]) for _, d, p in rows]
        parts.append(DepthExamples([relative_keypoints(*a) for a, _, _ in rows], targets))
    trainee = PoseDepthTrainee(*parts, width=64)
    settings = TrainingSettings(steps=300, batch=64, learning_rate=2e-3, ema=0.98)
    result = train(trainee, settings, tmp_path, progress=False)
    average = np.mean(
        [
            np.abs(t[:, :J] - np.concatenate(parts[0].targets).mean(axis=0)[:J]).mean()
            for t in parts[1].targets
        ]
    )
    assert result.saved["validation_loss"] < 0.7 * average


def test_the_shipped_network_knows_gaits_that_it_has_not_seen():
    """Made gaits are no clips of the training."""
    network, errors, sizes, pitches = PoseDepth.load(), [], [], []
    for video in videos(("walk", "march"), (1, 2)):
        arguments, depth, pitch = example(video)
        estimate = network.estimate(*arguments, RATE)
        errors.append(np.abs(estimate.depth - depth))
        sizes.append(np.abs(depth))
        pitches.append(np.degrees(abs(estimate.pitch.mean() - pitch)))
        assert np.quantile(errors[-1] / estimate.spread, 0.9) < 6
    assert np.mean(errors) < 0.6 * np.mean(sizes)
    assert np.median(pitches) < 5


def test_what_is_not_seen_is_less_certain():
    network = PoseDepth.load()
    (points, visible, *path), _, _ = example(videos(("walk",), (1,))[0])
    shown = network.estimate(points, visible, *path, RATE).spread
    arm = [KEYPOINTS.index(PERSON.joint_names.index(f"left_{name}")) for name in ("elbow", "wrist")]
    hidden = visible.copy()
    hidden[:, arm] = False
    assert (
        network.estimate(points, hidden, *path, RATE).spread[:, arm].mean()
        > 1.2 * shown[:, arm].mean()
    )
    nothing = network.estimate(points, np.zeros_like(visible), *path, RATE).spread
    assert nothing.mean() > 3 * shown.mean()

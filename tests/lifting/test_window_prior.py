import numpy as np

from probmotion.models.mixture.spectrum import from_frequencies


def test_cosines_are_those_of_the_transform(window_prior):
    L = window_prior.frames
    assert np.allclose(
        window_prior.cosines(np.arange(L)), from_frequencies(np.eye(L), axis=1).T, atol=1e-12
    )


def test_components_have_the_covariance_of_the_prior(window_prior):
    k, prior = 5, window_prior.prior
    part = window_prior.component(k)
    flat = part.basis.reshape(-1, len(part.variance))
    reduced = (flat * part.variance) @ flat.T
    V = prior.directions[k][prior.band]
    transform = from_frequencies(np.eye(window_prior.frames), axis=1).T  # (t, f)
    variances = prior.variances[k].copy()
    variances[0, :2] = part.variance[part.ground]
    full = np.einsum("tf,fap,fp,fbp,sf->tasb", transform, V, variances, V, transform)
    full = full.reshape(reduced.shape)
    # Only coefficients of less than 2 cm are left out.
    left_out = np.linalg.eigvalsh(full - reduced)
    assert left_out.min() > -1e-9
    assert left_out.max() <= 0.02**2 + 1e-9


def test_screening_prefers_the_component_and_heading_of_a_motion(window_prior):
    k, yaw = 12, 7
    mean = window_prior.component(k).mean
    c, s = np.cos(window_prior.yaws[yaw]), np.sin(window_prior.yaws[yaw])
    world = mean @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    limbs = list(range(2, 14))
    scores = window_prior.screen(world[:, limbs, :2], limbs, 0.0)
    assert abs(int(scores[k].argmax()) - yaw) <= 2
    assert scores[k, yaw] > scores[k, (yaw + 12) % 24] + 10
    assert scores[k, yaw] > np.median(scores.max(axis=1))

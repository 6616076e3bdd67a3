"""Speed of Motion-DVAE denoising at the published size on the CPU.

A motion of 300 frames is cut into overlapping windows that form one batch. Weights are untrained;
the amount of computation does not depend on them.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable

import numpy as np

from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.dvae.inference import DenoisingNetworks
from probmotion.models.dvae.motion_denoiser import MotionDenoiser, NoisyMotion
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.training import DVAETrainee
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.samplers import DVAEInference

FRAMES, WINDOW, ITERATIONS, SEQUENCES = 300, 30, 50, 64


def main() -> None:
    """Print every measurement."""
    skeleton = Skeleton.preset("person14")
    walks = [clip.retarget(skeleton) for clip in synthetic_walks(3, skeleton, seconds=10.0)]
    prior, denoiser = untrained_networks(walks)
    joints = noisy_joints(walks[0], FRAMES)
    posterior = MotionPosterior(prior.of(frames=FRAMES, inference_network=denoiser), joints)
    regression = DVAEInference()
    fit = DVAEInference(mode="optimization", iterations=ITERATIONS)

    def predict(sampler: DVAEInference) -> Callable[[], object]:
        return lambda: sampler.predict(posterior, progress=False)

    report("regression_seconds_per_frame", fastest(predict(regression), 3) / FRAMES)
    report("optimization_seconds_per_frame", fastest(predict(fit), 1) / FRAMES)
    report("batch_throughput_ratio", throughput_ratio(prior, denoiser, walks[0]))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report("memory_gib", peak / (2**30 if sys.platform == "darwin" else 2**20))


def untrained_networks(walks: list[Motion]) -> tuple[MotionDVAE, MotionDenoiser]:
    """Return an untrained prior of the published size and its denoiser."""
    states = BodyStates(
        walks[0].skeleton, rest_pose(walks[0].skeleton, [w.positions for w in walks])
    )
    trainee = DVAETrainee(walks, walks, DVAESettings.paper(), states)
    prior = MotionDVAE(
        trainee.network, trainee.size, states, walks[0].fps, card={"network": trainee.settings}
    )
    return prior, MotionDenoiser(DenoisingNetworks(prior), prior)


def noisy_joints(motion: Motion, frames: int) -> Joints3D:
    """Return noisy joints of the first frames of a motion."""
    return Joints3D.observe(motion.window(0, frames), 0.03, seed=0)


def throughput_ratio(prior: MotionDVAE, denoiser: MotionDenoiser, motion: Motion) -> float:
    """Return the throughput of a batch over that of single sequences."""
    single = denoiser.on(prior, noisy_joints(motion, WINDOW))
    batch = NoisyMotion(single.denoiser, single.windows.repeated(SEQUENCES), single.stitching)
    rng = np.random.default_rng(0)
    single_seconds = fastest(lambda: single.bound(rng), 5)
    batch_seconds = fastest(lambda: batch.bound(rng), 3)
    return SEQUENCES * single_seconds / batch_seconds


def fastest(work: Callable[[], object], times: int) -> float:
    """Return the minimum duration of several runs, after one warm-up run."""
    work()
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def report(name: str, value: float) -> None:
    """Print one measurement."""
    print(f"{name}: {value:.4g}", flush=True)


if __name__ == "__main__":
    main()

"""Third phase of the motion VAE: the distribution of its codes, and a calibrated encoder.

The VAE's own encoder minimises a weighted loss, so that its standard deviations have no meaning as
uncertainty. Here its last maps learn from simulated keypoints, whose codes are known.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.latent.code_mixture import CodeMixture
from probmotion.models.training.checkpoints import load_checkpoint, load_weights
from probmotion.models.training.devices import half_precision
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.losses import project_to_image
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.network import MotionVAEModel
from probmotion.models.vae.training import MotionVAETrainee

__all__ = ["EncodedWindows", "EncoderTrainee", "with_learnt_codes"]

_WINDOWS = 8192  # most windows of the tracks; fewer if there are fewer frames
_BATCH = 256
_SIMULATED = 8192  # codes whose keypoints are simulated
_COMPONENTS, _WINDOWS_PER_COMPONENT = 32, 64
_ROUNDS = 2  # of calibration; a third hardly changes the speed of draws


@dataclass(frozen=True, eq=False)
class EncodedWindows:
    """Random training windows: their codes and what the code does not say.

    ``mean``, ``log_variance`` (N, Z); ``rotation`` (N, L, 3, 3): from the body to the camera;
    ``log_lengths`` (N, G); ``seen`` (N, L, J); ``deviation``: of the keypoints from the decoded
    motion, metres.
    """

    mean: torch.Tensor
    log_variance: torch.Tensor
    rotation: torch.Tensor
    log_lengths: torch.Tensor
    seen: torch.Tensor
    deviation: float

    @classmethod
    @torch.no_grad()
    def of(cls, trainee: MotionVAETrainee, model: MotionVAEModel) -> EncodedWindows:
        """Encode random windows of a trainee's tracks."""
        device = torch.device("cpu")
        n = min(_WINDOWS, trainee.batches.description["frames"])
        rng, parts, squares = seeds.generator(0, "windows"), [], []
        model = model.eval().to(device)
        for start in range(0, n, _BATCH):
            rows = min(_BATCH, n - start)
            keypoints, seen, rest, teacher = trainee.taught_windows(rng, rows, device)
            mean, log_variance = model.vae.encode(keypoints, seen, rest)
            place = nn.functional.pad(teacher.translation, (0, 1))
            fixed = teacher.rotation, place, teacher.log_lengths
            posed = trainee.body.positions(model.vae.decode(mean), *fixed)
            error = project_to_image(posed, trainee.distance) - keypoints
            squares.append(error[seen > 0].square().mean())
            parts.append((mean, log_variance, teacher.rotation, teacher.log_lengths, seen))
        deviation = float(torch.stack(squares).mean().sqrt())
        mean, log_variance, rotation, log_lengths, seen = map(torch.cat, zip(*parts, strict=True))
        return cls(mean, log_variance, rotation, log_lengths, seen, deviation)

    def simulated(
        self,
        model: MotionVAEModel,
        body: ArticulatedBody,
        distance: float | None,
        rng: np.random.Generator,
        n: int,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return n codes (n, Z), their keypoints (n, L, J, 2) and visibility (n, L, J).

        Codes and bone lengths are those of one window, view and occlusions those of another.
        """
        rows, views = torch.as_tensor(rng.integers(0, len(self.mean), (2, n)))

        def normal(*size: int) -> torch.Tensor:
            return torch.as_tensor(rng.standard_normal(size, dtype=np.float32))

        root, seen = body.skeleton.roots[0], self.seen[views].clone()
        seen[..., root] = 1.0
        deviation = (0.5 * self.log_variance[rows]).exp()
        z = self.mean[rows] + deviation * normal(n, self.mean.shape[1])
        with torch.no_grad():
            origin = torch.zeros((n, seen.shape[1], 3))
            fixed = self.rotation[views], origin, self.log_lengths[rows]
            posed = body.positions(model.vae.decode(z), *fixed)
            image = project_to_image(posed, distance)
            image = image + self.deviation * normal(*image.shape)
        centred = image - image[:, :, [root]]
        return z, torch.where(seen[..., None] > 0, centred, 0.0), seen


class EncoderTrainee:
    """Trainee of the third phase: the encoder's last maps, on simulated keypoints.

    The maps from the tokens μ and σ to mean and log variance are learnt; the rest of the encoder is
    fixed. The loss is −E[log q(z | keypoints)] of codes that are known, so that variances are those
    of the errors.

    Parameters
    ----------
    trainee : MotionVAETrainee
        The second phase.
    model : MotionVAEModel
        Its networks, learnt.
    windows : EncodedWindows
        Windows of its tracks.
    """

    kind = "motion-vae-encoder"

    def __init__(
        self, trainee: MotionVAETrainee, model: MotionVAEModel, windows: EncodedWindows
    ) -> None:
        self._model = model
        self.network = copy.deepcopy(model.vae.time_encoder).requires_grad_(False)
        for part in (self.network.mean, self.network.log_variance):
            part.requires_grad_(True)
        self.settings = dict(trainee.settings)
        codes, tokens = [], []
        rest = torch.as_tensor(trainee.body.rest_positions, dtype=torch.float32)
        rng, fixed = seeds.generator(0, "simulated"), (trainee.body, trainee.distance)
        for _ in range(_SIMULATED // _BATCH):
            z, keypoints, seen = windows.simulated(model, *fixed, rng, _BATCH)
            with torch.no_grad():
                frames = model.vae.frame_encoder(keypoints, seen, rest)
                tokens.append(model.vae.time_encoder.attended(frames))
            codes.append(z)
        self._simulated = torch.cat(codes), torch.cat(tokens)

    def learnt(self, folder: str | Path) -> MotionVAEModel:
        """Return the networks with the encoder of a training run."""
        tensors = load_checkpoint(folder, self.kind).tensors
        load_weights(self.network.cpu(), tensors, self.kind)
        model = copy.deepcopy(self._model)
        model.vae.time_encoder.load_state_dict(self.network.state_dict())
        return model

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the mean loss of random codes, in single precision."""
        rows = torch.as_tensor(rng.integers(_BATCH, _SIMULATED, batch))
        with half_precision(device, False):
            return self._loss(network, rows, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss of codes that are not used in training."""
        return float(self._loss(network, torch.arange(_BATCH), device))

    def _loss(self, network: nn.Module, rows: torch.Tensor, device: torch.device) -> torch.Tensor:
        z, tokens = (part[rows].to(device) for part in self._simulated)
        mean, log_variance = network.read(tokens)
        return 0.5 * (log_variance + (z - mean) ** 2 * (-log_variance).exp()).sum(dim=-1).mean()


def with_learnt_codes(
    trainee: MotionVAETrainee,
    prior: MotionVAE,
    settings: TrainingSettings,
    folder: str | Path,
    *,
    learn: Callable[..., object] = train,
) -> MotionVAE:
    """Return the prior with the distribution of its training codes and a calibrated encoder.

    Twice, the encoder is calibrated on simulations from its own codes of training windows, which
    change with it. The mixture is fitted to the codes of the second time.

    Parameters
    ----------
    trainee : MotionVAETrainee
        The second phase.
    prior : MotionVAE
        What it learnt.
    settings : TrainingSettings
        Of the third phase.
    folder : str or Path
        Folder of its two runs.
    learn : callable
        Trains the encoder, as :func:`~probmotion.models.training.trainer.train`.
    """
    model = prior.model
    for number in range(_ROUNDS):
        run = Path(folder) / str(number)
        windows = EncodedWindows.of(trainee, model)
        encoder = EncoderTrainee(trainee, model, windows)
        learn(encoder, settings, run)
        model = encoder.learnt(run)
    mean, log_variance = windows.mean.double().numpy(), windows.log_variance.double().numpy()
    rng = seeds.generator(0, "codes")
    components = min(_COMPONENTS, max(1, len(mean) // _WINDOWS_PER_COMPONENT))
    codes = CodeMixture.fit(mean, np.exp(log_variance), components, rng)
    card = {**prior.card, "deviation": windows.deviation}
    given = model.vae, model.pose, prior.settings, prior.body, prior.fps
    return MotionVAE(*given, card=card, codes=codes)

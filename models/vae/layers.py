"""Layers of the motion VAE, with the spatial encoder E_s and decoder D_s.

Source: Ponymation, section 3.3 and table 5.

Decoders attend to a memory of one token. The softmax over one token is 1, so cross-attention is a
linear map of the memory, the same for every query, and is computed once. Names of weights match the
shipped checkpoints.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from probmotion.extras import nn, torch
from probmotion.models.training.devices import half_precision, is_half_precision
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.short_attention import short_attention
from probmotion.validation import check_shape

__all__ = [
    "FRAMES_AT_ONCE",
    "BoneDecoder",
    "FrameEncoder",
    "ImageFeatures",
    "Readout",
    "TransformerLayer",
    "body_size",
    "check_frames",
    "mixed_precision",
]

ImageFeatures = tuple[torch.Tensor, torch.Tensor]
"""Image features of frames, (B, T, F), and at their joints, (B, T, J, F)."""

FRAMES_AT_ONCE = 160
"""Batch size in frames for networks over joints or bones.

Limits memory and fits the processor cache: training steps take 10 % less time than with 640 frames.
"""

_INITIAL_SCALE = 0.05  # factor of the initial weights of a quiet `Readout`


class TransformerLayer(nn.Module):
    """Pre-norm transformer layer: self-attention, optional cross-attention and a perceptron.

    ``memory`` is the size of the memory token of a decoder layer; 0 for an encoder layer.
    """

    def __init__(self, size: MotionVAESettings, memory: int = 0) -> None:
        super().__init__()
        width = size.width
        self.heads = size.heads
        self.attention_norm = nn.LayerNorm(width)
        self.asked_keys_values = nn.Linear(width, 3 * width)
        self.attended = nn.Linear(width, width)
        self.perceptron_norm = nn.LayerNorm(width)
        self.perceptron = nn.Sequential(
            nn.Linear(width, size.feedforward), nn.GELU(), nn.Linear(size.feedforward, width)
        )
        if memory:
            # Product W_O W_V of attention to one token; queries and keys have no effect.
            self.told = nn.Linear(memory, width)

    def forward(
        self,
        tokens: torch.Tensor,
        memory: torch.Tensor | None = None,
        *,
        seen: torch.Tensor | None = None,
        first: int | None = None,
    ) -> torch.Tensor:
        """Return the tokens after this layer, ``(N, K, width) → (N, first, width)``.

        N may be 1 for tokens shared by all memories, (N, memory). ``seen`` (N, K) is True for
        tokens to attend to. ``first`` limits the result to the first tokens.
        """
        normalised = self.attention_norm(tokens)
        if first is None:
            result = _attend(self.asked_keys_values(normalised), self.heads, seen)
        else:
            result = self._attend_first(first, normalised, seen)
        tokens = tokens[:, :first] + self.attended(result)
        if memory is not None:
            tokens = tokens + self.told(memory)[:, None]
        return tokens + self.perceptron(self.perceptron_norm(tokens))

    def _attend_first(
        self, first: int, tokens: torch.Tensor, seen: torch.Tensor | None
    ) -> torch.Tensor:
        """Return the attention output of the first tokens, ``(N, first, width)``.

        For few queries it is cheaper to compute Qᵀ(W_K x) as (W_Kᵀ Q)ᵀ x, and to apply W_V after
        averaging. The bias of the keys shifts all scores alike and has no effect.
        """
        linear, width = self.asked_keys_values, tokens.shape[-1]
        query_weights, key_weights, value_weights = linear.weight.unflatten(0, (3, self.heads, -1))
        queries = nn.functional.linear(
            tokens[:, :first], query_weights.flatten(0, 1), linear.bias[:width]
        )
        queries = torch.einsum(
            "nqhd,hdw->nhqw", queries.unflatten(-1, (self.heads, -1)), key_weights
        )
        scores = torch.einsum("nhqw,nkw->nhqk", queries, tokens) * key_weights.shape[1] ** -0.5
        if seen is not None:
            scores = scores.masked_fill(~seen[:, None, None], -torch.inf)
        mean = torch.einsum("nhqk,nkw->nhqw", scores.softmax(dim=-1), tokens)
        result = torch.einsum("nhqw,hdw->nqhd", mean, value_weights).flatten(2)
        return result + linear.bias[2 * width :]


class Readout(nn.Linear):
    """Linear map to physical quantities that always multiplies in the precision of its weights.

    ``quiet`` scales the initial weights so that initial motions are close to the rest pose.
    """

    def __init__(self, width: int, outputs: int, *, quiet: bool = True) -> None:
        super().__init__(width, outputs)
        if quiet:
            with torch.no_grad():
                self.weight.mul_(_INITIAL_SCALE)
                self.bias.zero_()

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """Return the outputs, ``(…, width) → (…, outputs)``."""
        with half_precision(tokens.device, False):
            return super().forward(tokens.to(self.weight.dtype))


class FrameEncoder(nn.Module):
    """Spatial encoder E_s: encodes the joints of a frame into the output of a learnt token.

    The descriptor of a joint contains its keypoint, confidence, rest position, image features and
    index (one hot). Occluded joints are masked.
    """

    def __init__(self, size: MotionVAESettings, n_joints: int) -> None:
        super().__init__()
        self.features = size.image_features
        self.enter = nn.Linear(6 + 2 * self.features, size.width)
        self.joints = nn.Parameter(torch.randn(n_joints, size.width))
        self.asked = nn.Parameter(torch.randn(1, size.width))
        self.layers = nn.ModuleList(TransformerLayer(size) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)

    def forward(
        self,
        keypoints: torch.Tensor,
        confidence: torch.Tensor,
        rest: torch.Tensor,
        features: ImageFeatures | None = None,
    ) -> torch.Tensor:
        """Return frame vectors, (B, T, width); see :meth:`MotionVAENetwork.encode`."""
        check_frames(keypoints, confidence, rest, features, len(self.joints), self.features)
        seen = confidence > 0
        parts = [
            torch.where(seen[..., None], keypoints, 0.0) / body_size(rest),
            confidence[..., None],
            (rest / body_size(rest)).expand(*seen.shape, 3),
        ]
        if features is not None:
            # Occluded joints have no image location.
            local = torch.where(seen[..., None], features[1], 0.0)
            parts += [features[0][:, :, None].expand_as(local), local]
        described = torch.cat(parts, dim=-1).flatten(0, 1)
        seen = nn.functional.pad(seen.flatten(0, 1), (1, 0), value=True)
        batches = zip(described.split(FRAMES_AT_ONCE), seen.split(FRAMES_AT_ONCE), strict=True)
        result = torch.cat([self._encode(part, mask) for part, mask in batches])
        return result.unflatten(0, keypoints.shape[:2])

    def _encode(self, described: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        joints = self.enter(described) + self.joints
        queries = self.asked.to(joints.dtype).expand(len(joints), 1, -1)
        tokens = _cast_tokens(torch.cat([queries, joints], dim=1))
        for layer in self.layers[:-1]:
            tokens = layer(tokens, seen=seen)
        # Only the learnt token of the last layer is needed.
        return self.norm(self.layers[-1](tokens, seen=seen, first=1)[:, 0])


class BoneDecoder(nn.Module):
    """Spatial decoder D_s: decodes frame vectors into bone rotations, with a query per bone."""

    def __init__(self, size: MotionVAESettings, n_bones: int) -> None:
        super().__init__()
        self.bones = nn.Parameter(torch.randn(n_bones, size.width))
        self.layers = nn.ModuleList(TransformerLayer(size, size.width) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)
        self.leave = Readout(size.width, 3)

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """Return rotation vectors: ``(…, width) → (…, bones, 3)``, radians."""
        memories = frames.flatten(0, -2).split(FRAMES_AT_ONCE)
        result = torch.cat([self._rotation_vectors(memory) for memory in memories])
        return result.unflatten(0, frames.shape[:-1])

    def _rotation_vectors(self, memory: torch.Tensor) -> torch.Tensor:
        # The first layer's self-attention is the same for every frame and is computed once.
        tokens, memory = _cast_tokens(self.bones[None]), _cast_tokens(memory)
        for layer in self.layers:
            tokens = layer(tokens, memory)
        return self.leave(self.norm(tokens))


def _attend(packed: torch.Tensor, heads: int, seen: torch.Tensor | None) -> torch.Tensor:
    """Return the attention output; the arguments are those of :func:`short_attention`."""
    if packed.dtype == torch.bfloat16 and packed.device.type == "cpu":
        return short_attention(packed, heads, seen)
    queries, keys, values = packed.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
    mask = None if seen is None else seen[:, None, None]
    result = nn.functional.scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
    return result.transpose(1, 2).flatten(2)


def mixed_precision(network: nn.Module, device: torch.device) -> AbstractContextManager[object]:
    """Return the autocast context of a network: bfloat16 in training if its settings request it.

    An autocast enabled by the trainer remains active.
    """
    enabled = network.settings.mixed_precision and network.training
    return half_precision(device, enabled or is_half_precision(device))


def _cast_tokens(tokens: torch.Tensor) -> torch.Tensor:
    """Cast joint or bone tokens to the autocast type, which halves the memory traffic of sums."""
    if not is_half_precision(tokens.device):
        return tokens
    return tokens.to(torch.get_autocast_dtype(tokens.device.type))


def body_size(rest: torch.Tensor) -> torch.Tensor:
    """Return the mean distance of joints from the root, metres: the unit of joint descriptors.

    Unscaled keypoints would be small compared with the joint embedding.
    """
    return torch.linalg.norm(rest, dim=-1).mean()


def check_frames(
    keypoints: torch.Tensor,
    confidence: torch.Tensor,
    rest: torch.Tensor,
    features: ImageFeatures | None,
    n_joints: int,
    n_features: int,
) -> None:
    """Raise ``ValueError`` unless shapes and image features match the settings."""
    check_shape("keypoints", keypoints, ("B", "T", n_joints, 2))
    batch, frames = keypoints.shape[:2]
    check_shape("confidence", confidence, (batch, frames, n_joints))
    check_shape("rest", rest, (n_joints, 3))
    if not n_features:
        if features is not None:
            raise ValueError(f"features must be None for image_features=0, got {type(features)}")
        return
    if not (isinstance(features, tuple) and len(features) == 2):
        raise ValueError(
            "features must be a tuple (frame features, joint features) for "
            f"image_features={n_features}, got {type(features).__name__}"
        )
    check_shape("features[0]", features[0], (batch, frames, n_features))
    check_shape("features[1]", features[1], (batch, frames, n_joints, n_features))

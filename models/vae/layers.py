"""What the networks of the motion VAE are made of: E_s, D_s, and their layers.

Source: Ponymation, section 3.3 and table 5.

Every memory that a decoder reads is one token. The softmax over one token is 1 whatever is asked,
so that attention to it is a linear map of it, the same for every query: it is computed once.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

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
"""Of frames, (B, T, F), and of the places in the image where their joints are, (B, T, J, F)."""

FRAMES_AT_ONCE = 160
"""Frames whose joints or bones go through a network together.

It bounds the memory, and what one layer writes for so few the next still finds in a processor's
cache: a step of training takes a tenth less than with 640.
"""

_FIRST_OUTPUT = 0.05


class TransformerLayer(nn.Module):
    """Self-attention, what a memory says, and a perceptron, each added to the normalised tokens.

    Normalisation stands before each part, so that no warm-up is needed.

    Parameters
    ----------
    size : MotionVAESettings
        Width, heads and hidden width.
    memory : int
        Numbers of the one token that a decoder's layer reads; 0: an encoder's layer, with none.
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
            # W_O W_V of attention to one token; queries and keys would have no effect.
            self.told = nn.Linear(memory, width)

    def forward(
        self,
        tokens: torch.Tensor,
        memory: torch.Tensor | None = None,
        *,
        seen: torch.Tensor | None = None,
        first: int | None = None,
    ) -> torch.Tensor:
        """Return the tokens after this layer.

        Parameters
        ----------
        tokens : Tensor, (N, K, width)
            N may be 1 for queries that are the same for all memories.
        memory : Tensor, (N, memory), optional
            The token that a decoder reads.
        seen : Tensor of bool, (N, K), optional
            Tokens that may be looked at; all by default.
        first : int, optional
            How many tokens are needed of the result: the first ones. All by default.

        Returns
        -------
        Tensor, (N, first, width)
        """
        normalised = self.attention_norm(tokens)
        if first is None:
            found = _looked_up(self.asked_keys_values(normalised), self.heads, seen)
        else:
            found = self._first_look_up(first, normalised, seen)
        tokens = tokens[:, :first] + self.attended(found)
        if memory is not None:
            tokens = tokens + self.told(memory)[:, None]
        return tokens + self.perceptron(self.perceptron_norm(tokens))

    def _first_look_up(
        self, first: int, tokens: torch.Tensor, seen: torch.Tensor | None
    ) -> torch.Tensor:
        """Return what the first tokens find, ``(N, first, width)``.

        They are fewer than those that they look at: Qᵀ(W_K x) is computed as (W_Kᵀ Q)ᵀ x, and what
        is found as W_V of a mean over tokens. Whatever is added to all keys alike has no effect.
        """
        linear, width = self.asked_keys_values, tokens.shape[-1]
        of_asked, of_keys, of_values = linear.weight.unflatten(0, (3, self.heads, -1))
        asked = functional.linear(tokens[:, :first], of_asked.flatten(0, 1), linear.bias[:width])
        asked = torch.einsum("nqhd,hdw->nhqw", asked.unflatten(-1, (self.heads, -1)), of_keys)
        scores = torch.einsum("nhqw,nkw->nhqk", asked, tokens) * of_keys.shape[1] ** -0.5
        if seen is not None:
            scores = scores.masked_fill(~seen[:, None, None], -torch.inf)
        mean = torch.einsum("nhqk,nkw->nhqw", scores.softmax(dim=-1), tokens)
        found = torch.einsum("nhqw,hdw->nqhd", mean, of_values).flatten(2)
        return found + linear.bias[2 * width :]


class Readout(nn.Linear):
    """A linear map to numbers with units; it multiplies in its weights' precision, always.

    Parameters
    ----------
    width : int
        Numbers that it reads.
    outputs : int
        Numbers that it returns.
    quiet : bool
        Whether it begins near 0, so that first motions are near the rest pose.
    """

    def __init__(self, width: int, outputs: int, *, quiet: bool = True) -> None:
        super().__init__(width, outputs)
        if quiet:
            with torch.no_grad():
                self.weight.mul_(_FIRST_OUTPUT)
                self.bias.zero_()

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """Return the numbers, ``(…, width) → (…, outputs)``."""
        with torch.autocast(tokens.device.type, enabled=False):
            return super().forward(tokens.to(self.weight.dtype))


class FrameEncoder(nn.Module):
    """E_s: the joints of a frame → one vector, what a learnt token makes of them.

    A joint's token is a linear map of its descriptor: keypoint, confidence, rest position, image
    features and index (one hot). Joints that are not seen are not looked at.

    Parameters
    ----------
    size : MotionVAESettings
        Of the transformer, and how many image features there are.
    n_joints : int
        J.
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
        """Return the vectors of frames, (B, T, width); arguments as `MotionVAENetwork.encode`'s."""
        check_frames(keypoints, confidence, rest, features, len(self.joints), self.features)
        seen = confidence > 0
        parts = [
            torch.where(seen[..., None], keypoints, 0.0) / body_size(rest),
            confidence[..., None],
            (rest / body_size(rest)).expand(*seen.shape, 3),
        ]
        if features is not None:
            # A joint that is not seen has no place in the image whose feature could be read.
            local = torch.where(seen[..., None], features[1], 0.0)
            parts += [features[0][:, :, None].expand_as(local), local]
        described = torch.cat(parts, dim=-1).flatten(0, 1)
        seen = functional.pad(seen.flatten(0, 1), (1, 0), value=True)
        found = [
            self._found(some, looked_at)
            for some, looked_at in zip(
                described.split(FRAMES_AT_ONCE), seen.split(FRAMES_AT_ONCE), strict=True
            )
        ]
        return torch.cat(found).unflatten(0, keypoints.shape[:2])

    def _found(self, described: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        joints = self.enter(described) + self.joints
        asked = self.asked.to(joints.dtype).expand(len(joints), 1, -1)
        tokens = _working(torch.cat([asked, joints], dim=1))
        for layer in self.layers[:-1]:
            tokens = layer(tokens, seen=seen)
        # Of the last layer only the learnt token is read.
        return self.norm(self.layers[-1](tokens, seen=seen, first=1)[:, 0])


class BoneDecoder(nn.Module):
    """D_s: vectors of frames → turns of bones; queries are bones, the memory is a frame's vector.

    Parameters
    ----------
    size : MotionVAESettings
        Of the transformer.
    n_bones : int
        Bones.
    """

    def __init__(self, size: MotionVAESettings, n_bones: int) -> None:
        super().__init__()
        self.bones = nn.Parameter(torch.randn(n_bones, size.width))
        self.layers = nn.ModuleList(TransformerLayer(size, size.width) for _ in range(size.layers))
        self.norm = nn.LayerNorm(size.width)
        self.leave = Readout(size.width, 3)

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """Return rotation vectors: ``(…, width) → (…, bones, 3)``, radians."""
        memories = frames.flatten(0, -2).split(FRAMES_AT_ONCE)
        found = torch.cat([self._turns(memory) for memory in memories])
        return found.unflatten(0, frames.shape[:-1])

    def _turns(self, memory: torch.Tensor) -> torch.Tensor:
        # The first layer's attention is the same for every frame, and goes through once.
        tokens, memory = _working(self.bones[None]), _working(memory)
        for layer in self.layers:
            tokens = layer(tokens, memory)
        return self.leave(self.norm(tokens))


def _looked_up(
    asked_keys_values: torch.Tensor, heads: int, seen: torch.Tensor | None
) -> torch.Tensor:
    """Return what attention finds; arguments as :func:`short_attention`'s."""
    if asked_keys_values.dtype == torch.bfloat16 and asked_keys_values.device.type == "cpu":
        return short_attention(asked_keys_values, heads, seen)
    asked, keys, values = asked_keys_values.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4)
    mask = None if seen is None else seen[:, None, None]
    found = functional.scaled_dot_product_attention(asked, keys, values, attn_mask=mask)
    return found.transpose(1, 2).flatten(2)


def mixed_precision(network: nn.Module, device: torch.device) -> torch.autocast:
    """Return the context in which a network multiplies: bfloat16 in training if it is asked for.

    Where a trainer has asked for it already, that stays.
    """
    asked = network.settings.mixed_precision and network.training
    asked = asked or torch.is_autocast_enabled(device.type)
    return torch.autocast(device.type, torch.bfloat16, enabled=asked)


def _working(tokens: torch.Tensor) -> torch.Tensor:
    """Return the many tokens of joints or bones as they are summed up, bfloat16 where asked for.

    Sums in single precision would double the memory that a step reads and writes.
    """
    kind = tokens.device.type
    if not torch.is_autocast_enabled(kind):
        return tokens
    return tokens.to(torch.get_autocast_dtype(kind))


def body_size(rest: torch.Tensor) -> torch.Tensor:
    """Return the mean distance of joints from the root, metres: what descriptors are units of.

    In metres, keypoints would be drowned by what says which joint they are of.
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
    """Raise ``ValueError`` unless shapes fit, and image features are there if they are expected."""
    check_shape("keypoints", keypoints, ("B", "T", n_joints, 2))
    batch, frames = keypoints.shape[:2]
    check_shape("confidence", confidence, (batch, frames, n_joints))
    check_shape("rest", rest, (n_joints, 3))
    if features is None and n_features:
        raise ValueError(
            f"features is None, expected image features of image_features={n_features} numbers: "
            "(of frames, of joints)"
        )
    if features is None:
        return
    if not n_features:
        raise ValueError("features were given, expected None where image_features is 0")
    if not (isinstance(features, tuple) and len(features) == 2):
        raise ValueError(
            f"features is a {type(features).__name__}, expected a tuple of two tensors: "
            "(of frames, of joints)"
        )
    check_shape("features[0]", features[0], (batch, frames, n_features))
    check_shape("features[1]", features[1], (batch, frames, n_joints, n_features))

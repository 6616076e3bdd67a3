"""`Category`: what is known of all bodies of one kind: surface, colours, and how they move."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial import cKDTree

from probmotion.arrays import Array
from probmotion.extras import skimage  # noqa: F401  Its extra has all other libraries, too.
from probmotion.files import read_arrays, written_whole
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.images.posing import Skin
from probmotion.models.images.surface import Surface, rest_surface
from probmotion.models.latent.turn_code import TurnCode
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["Category", "MotionCode", "folded", "smooth_components", "vertex_normals"]

_FORMAT = 2
# Of the rest pose's size: lengths over which shapes and colours vary, and the deformations' size.
_SHAPE_LENGTH, _COLOUR_LENGTH, _SHAPE_SPREAD = 0.2, 0.15, 0.012
_SHAPES, _COLOURS = 6, 6
_COLOUR, _COLOUR_SPREAD = np.array([0.55, 0.4, 0.25]), 0.12
# Deviations of red, green and blue: brightness first, then hues.
_TINTS = np.array(
    [[1, 1, 1], [1, 0.8, 0.6], [0.6, 0.9, 1.2], [1.2, 1, 0.6], [1, 1, 1], [0.8, 1, 1]]
)
_LENGTH_SPREAD = 0.06
# Arrays that files contain in single precision, by attribute.
_VALUES = ("shapes", "albedo", "albedos", "features", "feature_noise")
_SYMMETRIC = 1e-5  # distance between mirrored vertices, of the size
_WEIGHTS = Path(__file__).parents[1] / "weights"


class MotionCode(Protocol):
    """Decoder of z ~ N(0, I) to bone rotations: a :class:`TurnCode` or a motion VAE."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def dim(self) -> int:
        """Length K of z."""

    @property
    def frames(self) -> int:
        """Number of frames L."""

    def turns(self, z: Array) -> Array:
        """Return the rotation vectors at z: ``(…, K) → (…, L, B, 3)``, radians."""


@dataclass(frozen=True, eq=False)
class Category:
    """Surface, shapes, colours and motions of one kind of body, each Gaussian.

    Parameters
    ----------
    name : str
        Name of the kind.
    body : ArticulatedBody
        Skeleton and rest pose.
    surface : Surface
        Mean surface in the rest pose, V vertices.
    shapes : ndarray, (S, V, 3)
        Deformations of the surface for one standard deviation, metres.
    albedo : ndarray, (V, 3)
        Mean reflectance of red, green and blue.
    albedos : ndarray, (A, V, 3)
        Its deviations for one standard deviation.
    code : MotionCode
        Distribution of bone rotations.
    length_spread : float
        Standard deviation of the logarithm of bone lengths.
    features : ndarray, (V, F)
        Mean image features of the vertices; F = 0 without.
    feature_noise : ndarray, (F,)
        Standard deviations of image features from those of the vertices.
    card : mapping
        Training record.
    source : Path, optional
        File that the category was loaded from; its encoder lies beside it.

    Raises
    ------
    ValueError
        If shapes disagree, a value is not finite, or a standard deviation is not above 0.
    """

    name: str
    body: ArticulatedBody
    surface: Surface
    shapes: np.ndarray
    albedo: np.ndarray
    albedos: np.ndarray
    code: MotionCode
    length_spread: float
    features: np.ndarray
    feature_noise: np.ndarray
    card: Mapping[str, Any] = field(default_factory=dict)
    source: Path | None = None

    def __post_init__(self) -> None:
        vertices = self.surface.vertices.shape
        check_shape("shapes", self.shapes, ("S", *vertices))
        check_shape("albedo", self.albedo, vertices)
        check_shape("albedos", self.albedos, ("A", *vertices))
        check_shape("features", self.features, (vertices[0], "F"))
        check_shape("feature_noise", self.feature_noise, self.features.shape[1:])
        for name in _VALUES:
            check_finite(name, getattr(self, name))
        skeleton = self.body.skeleton
        if self.surface.joints.min() < 0 or self.surface.joints.max() >= skeleton.n_joints:
            raise ValueError(f"joints must be of the body's {skeleton.n_joints}, got others")
        if isinstance(self.code, TurnCode):
            check_shape("mean", self.code.mean, ("L", len(self.body.bones), 3))
        check_positive("length_spread", self.length_spread)
        if (self.feature_noise <= 0).any():
            raise ValueError(f"feature_noise must be above 0, got {self.feature_noise.min():g}")

    @classmethod
    def of_capsules(cls, name: str, body: ArticulatedBody, code: MotionCode) -> Category:
        """Return a category that nothing was learnt of but the motions: a body of capsules.

        Shapes are smooth Gaussian deformations along the normals, symmetric like the body; colours
        are smooth Gaussian deviations from a brown that is lighter below.
        """
        surface = rest_surface(body)
        vertices, normals = surface.vertices, vertex_normals(surface)
        size = float(np.ptp(vertices, axis=0).max())
        points = folded(vertices)
        shapes = smooth_components(points, _SHAPE_LENGTH * size, _SHAPES)[:, :, None] * normals
        colours = smooth_components(points, _COLOUR_LENGTH * size, _COLOURS)[:, :, None]
        colours = colours * _TINTS[:, None]
        below = -normals[:, 1:2]
        return cls(
            name,
            body,
            surface,
            _SHAPE_SPREAD * size * shapes,
            np.clip(_COLOUR * (1 + 0.15 * below), 0.0, 1.0),
            _COLOUR_SPREAD * colours,
            code,
            _LENGTH_SPREAD,
            np.zeros((len(vertices), 0)),
            np.zeros(0),
        )

    @cached_property
    def skin(self) -> Skin:
        """Mean surface bound to the body."""
        return Skin(self.body, self.surface)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that :meth:`save` writes but the name and the card, hexadecimal."""
        settings, arrays = self._content()
        content = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
        for name, array in sorted(arrays.items()):
            content.update(f"{name} {array.dtype.str} {array.shape}".encode())
            content.update(np.ascontiguousarray(array).tobytes())
        return content.hexdigest()

    def check_features(self, features: np.ndarray | None) -> None:
        """Raise ``ValueError`` if there are image features (…, F') that are not of F channels."""
        known = self.features.shape[1]
        if features is not None and features.shape[-1] != known:
            rule = f"have {known} channels" if known else "be left out"
            raise ValueError(
                f"features must {rule} for the category {self.name}, got {features.shape[-1]} "
                "channels; train a category on images with such features to use them"
            )

    def check_images(self, images: int) -> None:
        """Raise ``ValueError`` if a clip has more images than the motions have frames."""
        if images > self.code.frames:
            raise ValueError(
                f"images must be at most {self.code.frames}, the frames of the category's motions, "
                f"got {images}"
            )

    def save(self, path: str | Path) -> None:
        """Write the category to an ``.npz`` file for :meth:`load`.

        Raises ``ValueError`` if its code is not a :class:`TurnCode`.
        """
        settings, arrays = self._content()
        text = {"format": _FORMAT, "name": self.name, **settings, "card": dict(self.card)}
        with written_whole(Path(path)) as unfinished, unfinished.open("wb") as file:
            np.savez_compressed(file, settings=np.array(json.dumps(text)), **arrays)

    def _content(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the settings and arrays of the file without name and card."""
        if not isinstance(self.code, TurnCode):
            raise ValueError(f"code must be a TurnCode to be saved, got {type(self.code).__name__}")
        settings = {
            "joint_names": list(self.body.skeleton.joint_names),
            "parents": [int(parent) for parent in self.body.skeleton.parents],
            "fps": float(self.code.fps),
            "length_spread": float(self.length_spread),
        }
        arrays = {
            "rest": self.body.rest.astype("<f8"),
            "vertices": self.surface.vertices.astype("<f8"),
            "triangles": self.surface.triangles.astype("<i4"),
            "joints": self.surface.joints.astype("<i2"),
            "weights": self.surface.weights.astype("<f8"),
            **{name: getattr(self, name).astype("<f4") for name in _VALUES},
            "turns_mean": self.code.mean.astype("<f4"),
            "turns_basis": self.code.basis.astype("<f4"),
        }
        return settings, arrays

    @classmethod
    def load(cls, source: str | Path) -> Category:
        """Load a category from a file of :meth:`save` or by a shipped name.

        Raises ``FileNotFoundError`` if there is none, and ``ValueError`` for another kind of file.
        """
        path = Path(source)
        shipped = _WEIGHTS / f"{source}-images.npz"
        path = shipped if not path.is_file() and shipped.is_file() else path
        if not path.is_file():
            names = sorted(
                p.name.removesuffix("-images.npz") for p in _WEIGHTS.glob("*-images.npz")
            )
            raise FileNotFoundError(
                f"category must be a file or one of {', '.join(names)}, got {source}"
            )
        try:
            arrays = read_arrays(path)
            text = json.loads(str(arrays["settings"]))
            if text["format"] != _FORMAT:
                raise ValueError(
                    f"format {text['format']} instead of {_FORMAT}; run probmotion train images"
                )
            body = ArticulatedBody(Skeleton(text["joint_names"], text["parents"]), arrays["rest"])
            surface = Surface(
                arrays["vertices"],
                arrays["triangles"].astype(np.int64),
                arrays["joints"].astype(np.int64),
                arrays["weights"],
            )
            named = {name: arrays[name].astype(np.float64) for name in _VALUES}
            mean, basis = (arrays[f"turns_{part}"].astype(np.float64) for part in ("mean", "basis"))
            return cls(
                text["name"],
                body,
                surface,
                code=TurnCode(mean, basis, text["fps"]),
                length_spread=text["length_spread"],
                card=text["card"],
                source=path,
                **named,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path.name} must be a category written by Category.save: {error}"
            ) from error


def vertex_normals(surface: Surface) -> np.ndarray:
    """Return unit normals of the vertices, (V, 3)."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(surface.vertices)
    for corner in range(3):
        np.add.at(normals, surface.triangles[:, corner], faces)
    unit: np.ndarray = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def folded(vertices: np.ndarray) -> np.ndarray:
    """Return |x|, y and z (V, 3) of a surface that is symmetric about x = 0, else the vertices.

    Functions of these points are symmetric if the surface is.
    """
    nearest, _ = cKDTree(vertices).query(vertices * [-1, 1, 1])
    if nearest.max() > _SYMMETRIC * np.ptp(vertices, axis=0).max():
        return vertices
    points: np.ndarray = np.abs(vertices * [1, 0, 0]) + vertices * [0, 1, 1]
    return points


def smooth_components(points: np.ndarray, length: float, n: int) -> np.ndarray:
    """Return the first ``n`` components (n, V) of a smooth Gaussian function of variance 1."""
    squares = ((points[:, None] - points) ** 2).sum(axis=-1)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * squares / length**2))
    components: np.ndarray = (vectors[:, ::-1] * np.sqrt(np.maximum(values[::-1], 0.0))).T[:n]
    # The sign of an eigenvector is arbitrary.
    return components * np.sign(components.sum(axis=1, keepdims=True))

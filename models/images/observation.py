"""Observed masks, colours and features of a body in one image or a clip."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probmotion.arrays import Array
from probmotion.io.errors import errors_in
from probmotion.models.images.crops import Crop, body_box
from probmotion.models.images.image_files import Source, read_features, read_image, read_mask
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["ImageObservation", "check_rotations"]

_WIDEST = 120.0  # degrees; the virtual camera sees any box in an image of this field of view
_SOURCES = (str, Path, np.ndarray)
_LEAST_SIZE, _LEAST_MARGIN = 8, 1.1  # the background on both sides is seen
_TRUNCATED = 0.01  # share of a body's outline; a leg that is cut off is wider


@dataclass(frozen=True, eq=False)
class ImageObservation:
    """Body in square crops of an image, or of the T images of a clip.

    Each crop is the image of a virtual pinhole camera at the place of the image's camera, which
    looks at the body. Axes of both are x right, y down, z forward. A point (x, y, z) of the virtual
    camera is in column S/2 (1 + x / (z tangent)) and row S/2 (1 + y / (z tangent)); centres of
    pixels are at .5.

    Parameters
    ----------
    mask : ndarray, (T, S, S)
        Share of each pixel that is the body, 0 to 1; NaN where unknown, as beyond the image.
    rgb : ndarray, (T, S, S, 3), or None
        Stored values (without gamma expansion), 0 to 1; NaN beyond the image.
    features : ndarray, (T, S, S, F), or None
        NaN beyond the image.
    tangent : ndarray, (T,)
        Tangent of half the field of view of each crop.
    rotation : ndarray, (T, 3, 3)
        From the axes of the image's camera to those of the virtual camera.

    Raises
    ------
    ValueError
        If shapes or values are other than these, or a mask lacks body or background.
    """

    mask: np.ndarray
    rgb: np.ndarray | None
    features: np.ndarray | None
    tangent: np.ndarray
    rotation: np.ndarray

    def __post_init__(self) -> None:
        mask = np.asarray(self.mask, dtype=np.float64)
        check_shape("mask", mask, ("T", "S", "S"))
        frames, size, width = mask.shape
        if not frames or not size or size != width:
            raise ValueError(f"mask must be of square crops (T, S, S), got shape {mask.shape}")
        _check_shares("mask", mask)
        for name, missing in (
            ("the body", ~(mask >= 0.5).any(axis=(1, 2))),
            ("the background", ~(mask < 0.5).any(axis=(1, 2))),
        ):
            if missing.any():
                frame = int(np.argmax(missing))
                raise ValueError(f"mask must show {name}, got no pixel of it in frame {frame}")
        object.__setattr__(self, "mask", mask)
        if self.rgb is not None:
            rgb = np.asarray(self.rgb, dtype=np.float64)
            check_shape("rgb", rgb, (frames, size, size, 3))
            _check_shares("rgb", rgb)
            if np.isnan(rgb[mask >= 0.5]).any():
                raise ValueError("rgb must be known where the mask shows the body, got NaN")
            object.__setattr__(self, "rgb", rgb)
        if self.features is not None:
            features = np.asarray(self.features, dtype=np.float32)
            check_shape("features", features, (frames, size, size, "F"))
            if np.isinf(features).any():
                raise ValueError("features must be finite, or NaN beyond the image, got inf")
            object.__setattr__(self, "features", features)
        self._set_cameras(frames)

    def _set_cameras(self, frames: int) -> None:
        tangent = np.asarray(self.tangent, dtype=np.float64)
        rotation = np.asarray(self.rotation, dtype=np.float64)
        check_shape("tangent", tangent, (frames,))
        check_shape("rotation", rotation, (frames, 3, 3))
        check_finite("tangent", tangent)
        if tangent.min() <= 0:
            raise ValueError(f"tangent must be above 0, got {tangent.min():g}")
        check_rotations("rotation", rotation)
        object.__setattr__(self, "tangent", tangent)
        object.__setattr__(self, "rotation", rotation)

    @property
    def images(self) -> int:
        """Number of images T."""
        return len(self.mask)

    @property
    def size(self) -> int:
        """Rows and columns S of the crops."""
        return self.mask.shape[1]

    @property
    def truncated(self) -> np.ndarray:
        """Whether more than 1 % of the body's outline borders unknown pixels, (T,).

        These are beyond the image, or NaN in the mask that was read.
        """
        body, unknown = self.mask >= 0.5, np.isnan(self.mask)
        outline, cut = np.zeros(self.images), np.zeros(self.images)
        for inside, hidden in (
            (body, unknown),
            (body.swapaxes(1, 2), unknown.swapaxes(1, 2)),
        ):
            before, after = inside[:, :-1], inside[:, 1:]
            ends = before & hidden[:, 1:] | after & hidden[:, :-1]
            outline += (before != after).sum(axis=(1, 2))
            cut += ends.sum(axis=(1, 2))
        return cut > _TRUNCATED * outline

    def log_density(self, positions: Array) -> Array:
        """Raise ``ValueError``: joints have no image; a ``SurfacePrior`` evaluates it."""
        raise ValueError(
            "prior must have a surface to be seen in an image, got joints alone; use a SurfacePrior"
        )

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> ImageObservation:
        """Raise ``ValueError``: joints have no image; ``make_images`` renders draws."""
        raise ValueError(
            "images must be simulated from a surface, got joints alone; use make_images"
        )

    @classmethod
    def read(
        cls,
        image: Source | Sequence[Source],
        mask: Source | Sequence[Source] | None = None,
        *,
        features: Source | Sequence[Source] | None = None,
        fov: float = 40.0,
        size: int = 128,
        margin: float = 1.25,
    ) -> ImageObservation:
        """Read an image, or the list of images of a clip, and crop it around the body.

        Parameters
        ----------
        image : str, Path or ndarray, or list of them
            Grey or coloured images of one size. Arrays (H, W), (H, W, 3) or (H, W, 4) are uint8,
            uint16, bool, or floats from 0 to 1.
        mask : str, Path or ndarray, or list of them, optional
            Images of the body's share of each pixel, or of the labels 0 and 1, in the size of the
            image; by default, the image's opacity. Arrays (H, W) of floats may contain NaN where it
            is unknown, as behind a fence.
        features : str, Path or ndarray, or list of them, optional
            Archives ``.npz`` with one array (rows, columns, F) each, on a grid of equal cells that
            covers the image, such as the patches of a network.
        fov : float
            Field of view along the longer side of the image, degrees, at most 120.
        size : int
            Rows and columns of the crops.
        margin : float
            Side of the crop in larger sides of the body's bounding box, at least 1.1.

        Raises
        ------
        MotionFileError
            If a file is damaged, is no image or archive, or its content is other than described.
        ValueError
            If the mask is empty or full, has another size than the image or several large parts, or
            another argument is other than described.
        FileNotFoundError
            If a file does not exist.
        """
        check_positive("fov", fov)
        check_positive("margin", margin)
        check_count("size", size, _LEAST_SIZE)
        if fov > _WIDEST:
            raise ValueError(f"fov must be at most {_WIDEST:g} degrees, got {fov:g}")
        if margin < _LEAST_MARGIN:
            raise ValueError(f"margin must be at least {_LEAST_MARGIN}, got {margin:g}")
        views: list[_View] = []
        for frame, sources in enumerate(_frames(image=image, mask=mask, features=features)):
            # Errors about arrays of a clip name the frame, others the file.
            with errors_in(f"frame {frame}") if isinstance(image, list | tuple) else nullcontext():
                views.append(_view(*sources, fov=fov, size=size, margin=margin))
                views[-1].check_like(views[0])
        return cls(
            mask=np.stack([view.mask for view in views]),
            rgb=np.stack([view.rgb for view in views]),
            features=None if features is None else np.stack([view.features for view in views]),
            tangent=np.array([view.crop.tangent for view in views]),
            rotation=np.stack([view.crop.rotation for view in views]),
        )


class _View(NamedTuple):
    """Crop of one image, whose height and width are ``shape``."""

    mask: np.ndarray
    rgb: np.ndarray
    features: Any  # ndarray or None
    crop: Crop
    shape: tuple[int, int]

    def check_like(self, first: _View) -> None:
        if self.shape != first.shape:
            raise ValueError(f"image must have the size {first.shape} of frame 0, got {self.shape}")
        if self.features is not None and self.features.shape != first.features.shape:
            raise ValueError(
                f"features must have the {first.features.shape[2]} channels of frame 0, got "
                f"{self.features.shape[2]}"
            )


def _view(
    image: Source,
    mask: Source | None,
    features: Source | None,
    fov: float,
    size: int,
    margin: float,
) -> _View:
    rgb, opacity = read_image(image)
    shape = rgb.shape[0], rgb.shape[1]
    source = image if mask is None else mask
    with nullcontext() if isinstance(source, np.ndarray) else errors_in(source):
        given = opacity if mask is None else mask
        if given is None:
            raise ValueError("mask must be given, since the image has no transparency")
        shares = read_mask(given, shape)
        box = body_box(shares)
    crop = Crop.around(box, shape, fov, margin)
    grid = None if features is None else read_features(features, shape)
    return _View(
        mask=np.clip(crop.resampled(shares[..., None], size)[..., 0], 0, 1),
        rgb=np.clip(crop.resampled(rgb, size), 0, 1),
        features=None if grid is None else crop.resampled(grid, size).astype(np.float32),
        crop=crop,
        shape=shape,
    )


def check_rotations(name: str, matrices: np.ndarray) -> None:
    """Raise ``ValueError`` unless matrices (T, 3, 3) are rotations."""
    check_finite(name, matrices)
    error = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max()
    if error > 1e-6 or np.linalg.det(matrices).min() < 0:
        raise ValueError(
            f"{name} must be of rotation matrices, got a deviation of {error:.2g} from "
            f"orthonormal ones and a determinant of {np.linalg.det(matrices).min():.3g}"
        )


def _check_shares(name: str, values: np.ndarray) -> None:
    if not ((values >= 0) & (values <= 1) | np.isnan(values)).all():
        low, high = np.nanmin(values), np.nanmax(values)
        raise ValueError(f"{name} must be from 0 to 1, or NaN, got {low:g} to {high:g}")


def _frames(**given: Any) -> list[tuple[Any, Any, Any]]:
    """Return the image, mask and features of each frame."""
    image = given["image"]
    many = isinstance(image, list | tuple)
    if many and not image:
        raise ValueError("image must contain at least one image, got an empty list")
    columns: list[list[Any]] = []
    for name, value in given.items():
        column = list(value) if isinstance(value, list | tuple) else [value]
        if value is None and many:
            column *= len(image)
        elif many and (isinstance(value, _SOURCES) or len(column) != len(image)):
            raise ValueError(
                f"{name} must be a list of {len(image)} for {len(image)} images, got {len(column)}"
            )
        elif not many and isinstance(value, list | tuple):
            raise ValueError(f"{name} must be a single one for a single image, got a list")
        for source in column:
            if not isinstance(source, _SOURCES) and not (value is None and name != "image"):
                raise ValueError(f"{name} must be a file or an array, got {type(source).__name__}")
        columns.append(column)
    images, masks, features = columns
    return list(zip(images, masks, features, strict=True))

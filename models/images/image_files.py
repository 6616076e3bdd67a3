"""Reader of images, masks and feature maps, from files or arrays, as shares of their full value."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from probmotion.files import read_arrays
from probmotion.io.errors import MotionFileError, errors_in, read_bytes
from probmotion.validation import check_finite, check_shape

__all__ = ["Source", "read_features", "read_image", "read_mask"]

Source = str | Path | np.ndarray
"""A file, or an array with the same content."""

_ORIENTATION = 0x0112  # EXIF tag; 1 is upright
_DEEP = ("I", "F")  # modes of 16-bit integers (I;16, and I for some formats) and of floats
_TRANSPARENT = ("LA", "La", "PA", "RGBA", "RGBa")
# Masks reach 1 inside the body. Those compressed with loss or predicted by networks nearly do;
# labels such as 1 to 200 in 8 bits do not.
_INSIDE = 0.9
_LABELS = 32  # integers below are labels, of several bodies if there are more than 0 and 1
# Grids of patches cover the image with cells that are nearly square, or have the image's aspect
# ratio. Arrays with the channels first have other shapes.
_MOST_ELONGATED = 4.0


def read_image(source: Source) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the colours (H, W, 3), and the opacity (H, W) if there is one, from 0 to 1.

    Grey images have three equal colours. Files have 8 or 16 bits (16 only if they are grey);
    arrays (H, W), (H, W, 3) or (H, W, 4) are uint8, uint16, bool, or floats from 0 to 1.

    Raises
    ------
    MotionFileError
        If a file is no image, is damaged, or is not upright.
    ValueError
        If an array has another shape or other values.
    FileNotFoundError
        If the file does not exist.
    """
    if isinstance(source, np.ndarray):
        return _image(source)
    with errors_in(source):
        image = _decoded(Path(source))
        if not image.mode.startswith(_DEEP):
            image = image.convert("RGBA" if _is_transparent(image) else "RGB")
        return _image(_pixels(image))


def read_mask(source: Source, shape: tuple[int, int]) -> np.ndarray:
    """Return the share of each pixel that is the body, (H, W), from 0 to 1.

    Pixels of integer arrays and of files are binary if none exceeds 1; else 255 (16 bits: 65535)
    is the body. The indices of coloured palettes are labels: 0 and 1. Arrays of floats may contain
    NaN where it is unknown whether a pixel is the body, as behind a fence.

    Parameters
    ----------
    source : str, Path or ndarray, (H, W)
    shape : tuple of int
        Height and width of the image.

    Raises
    ------
    MotionFileError
        If a file is no image, is damaged or not upright, or contains no such mask.
    ValueError
        If an array has another shape or other values.
    FileNotFoundError
        If the file does not exist.
    """
    if isinstance(source, np.ndarray):
        return _mask(source, shape)
    with errors_in(source):
        return _mask(_grey_pixels(_decoded(Path(source))), shape)


def read_features(source: Source, shape: tuple[int, int]) -> np.ndarray:
    """Return a feature map (h, w, F), float32, on a grid of equal cells that covers the image.

    Parameters
    ----------
    source : str, Path or ndarray, (h, w, F)
        File in ``.npz`` format with one array, of any name.
    shape : tuple of int
        Height and width of the image.

    Raises
    ------
    MotionFileError
        If a file is no such archive, or its array has another shape or is not finite.
    ValueError
        If an array has another shape or is not finite.
    FileNotFoundError
        If the file does not exist.
    """
    if isinstance(source, np.ndarray):
        return _features(source, shape)
    with errors_in(source):
        try:
            arrays = read_arrays(source)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise ValueError(f"expected a readable npz archive ({error.strerror})") from error
        if len(arrays) != 1:
            names = ", ".join(sorted(arrays))
            raise ValueError(f"expected one array of features, got {len(arrays)} ({names:.80})")
        return _features(next(iter(arrays.values())), shape)


def _decoded(path: Path) -> Image.Image:
    """Return the image of a file, with its pixels loaded."""
    content = io.BytesIO(_content(path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damaged metadata
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            Image.open(content).verify()  # checksums, which are not compared when pixels are read
            image = Image.open(content)
            frames = getattr(image, "n_frames", 1)
            orientation = image.getexif().get(_ORIENTATION, 1)
            image.load()
        except UnidentifiedImageError as error:
            raise ValueError("expected an undamaged image, such as PNG or JPEG") from error
        except Exception as error:  # damaged files raise many types, including SyntaxError
            raise ValueError(f"expected an undamaged image ({str(error)[:80]})") from error
    # Photographs in the format MPO contain previews of themselves.
    if frames != 1 and image.format != "MPO":
        raise ValueError(f"expected a single image, got {frames}; give a list of files for a clip")
    # Programs disagree about whether they rotate such images, so that masks may be of either.
    if orientation not in (0, 1):
        raise ValueError(
            f"expected an upright image, got EXIF orientation {orientation}; save a rotated copy "
            "and make the mask from that"
        )
    return image


def _content(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except MotionFileError as error:  # of motion files
        raise ValueError("expected a readable image file") from error


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in _TRANSPARENT or "transparency" in image.info


def _pixels(image: Image.Image) -> np.ndarray:
    """Return the pixels as stored, (H, W) or (H, W, channels)."""
    pixels = np.asarray(image)
    if image.mode == "I" and pixels.min() >= 0 and pixels.max() <= 0xFFFF:
        return pixels.astype(np.uint16)
    return pixels


def _grey_pixels(image: Image.Image) -> np.ndarray:
    """Return the pixels (H, W) of a mask: labels, or shares of the full value."""
    if image.mode.startswith(_DEEP):
        return _pixels(image)
    rgba = image.convert("RGBA")
    if rgba.getchannel("A").getextrema() != (255, 255):
        raise ValueError("mask must be opaque, got transparent pixels; save it in grey")
    colours = np.asarray(rgba)[..., :3]
    if (colours == colours[..., :1]).all():
        return colours[..., 0]
    labels = np.asarray(image)
    if image.mode == "P" and labels.max() == 1:
        return labels
    if image.mode == "P":
        found = ", ".join(map(str, np.unique(labels)))
        raise ValueError(f"mask must have the labels 0 and 1, got {found:.40}; save one per animal")
    raise ValueError("mask must be grey, got colours; save black and white")


def _image(array: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    colours = array.ndim == 3 and array.shape[2] in (3, 4)
    if not array.size or not (array.ndim == 2 or colours):
        raise ValueError(f"image must have shape (H, W), (H, W, 3) or (H, W, 4), got {array.shape}")
    values = _shares("image", array)
    check_finite("image", values)
    if values.ndim == 2:
        return np.repeat(values[..., None], 3, axis=2), None
    return values[..., :3], values[..., 3] if values.shape[2] == 4 else None


def _mask(array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    if array.shape != shape:  # images are not empty
        raise ValueError(
            f"mask must have the image's height and width {shape}, got shape {array.shape}"
        )
    if array.dtype.kind in "iu" and array.min() >= 0 and array.max() <= 1:
        array = array.astype(bool)
    elif array.dtype.kind in "iu" and array.min() >= 0 and array.max() < _LABELS:
        raise ValueError(
            f"mask must show one body, got labels 0 to {array.max()}; give one that is 1 or 255 in "
            "the body and 0 elsewhere"
        )
    values = _shares("mask", array)
    known = values[~np.isnan(values)]
    if known.size == 0 or known.max() == 0:
        raise ValueError("mask must show the body, got no pixel of it")
    if known.max() < _INSIDE:
        raise ValueError(
            f"mask must reach its full value in the body, got at most {known.max():.3f} of it; "
            "use 0 and 255"
        )
    if known.min() >= 0.5:
        raise ValueError("mask must show the background, got the body in every pixel")
    return values


def _features(array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise ValueError(f"features must be real numbers, got {array.dtype!s:.80}")
    check_shape("features", array, ("rows", "columns", "F"))
    rows, columns, channels = array.shape
    if min(rows, columns, channels) == 0:
        raise ValueError(f"features must not be empty, got shape {array.shape}")
    aspect = shape[0] * columns / (shape[1] * rows)
    if not 1 / _MOST_ELONGATED <= aspect <= _MOST_ELONGATED:
        raise ValueError(
            "features must have the shape (rows, columns, F) of a grid over the image of "
            f"{shape[0]} x {shape[1]} pixels, got {array.shape}"
        )
    with np.errstate(over="ignore"):  # too large numbers are not finite
        features = array.astype(np.float32)
    check_finite("features", features)
    return features


def _shares(name: str, array: np.ndarray) -> np.ndarray:
    """Return integers as shares of the largest of their type, and checked floats; float32."""
    if array.dtype == bool or array.dtype.kind == "f":
        values = array.astype(np.float32)
    elif array.dtype.kind == "u" and array.dtype.itemsize <= 2:
        values = array.astype(np.float32) / np.float32(np.iinfo(array.dtype).max)
    else:
        raise ValueError(
            f"{name} must be uint8, uint16, bool, or floats from 0 to 1, got {array.dtype!s:.80}"
        )
    if not ((values >= 0) & (values <= 1) | np.isnan(values)).all():
        low, high = np.nanmin(values), np.nanmax(values)
        raise ValueError(f"{name} must be from 0 to 1, got {low:g} to {high:g}")
    return values

"""Square crops of images around a body, as seen by a virtual camera that looks at it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, sparse

__all__ = ["Crop", "body_box"]

# An image's pixel is sampled at 4 x 4 points, at most one pixel of the (reduced) grid apart.
_SAMPLES = 4
_SEEN = 0.499  # least known share of a pixel of the crop: half, apart from rounding
# Parts of a body on both sides of a pole or rope are separated by less than this share of its
# bounding box.
_GAP = 0.05
# A part with a quarter of the largest part's area is another animal of half the size. Heads, legs
# and tails that an occluder separates are smaller; specks with a fiftieth do not count for the box.
_ANIMAL, _SPECK = 0.25, 0.02
_SMALLEST = 8  # pixels along the larger side of a body's bounding box
_LABELLED = 256  # pixels along the larger side of the mask in which parts are labelled


@dataclass(frozen=True, eq=False)
class Crop:
    """Virtual pinhole camera at the place of an image's camera, whose image is the crop.

    Axes of both cameras are x right, y down, z forward. The virtual camera has no roll: its x axis
    is perpendicular to the y axis of the image's camera.

    Parameters
    ----------
    rotation : ndarray, (3, 3)
        From the axes of the image's camera to those of the virtual camera.
    tangent : float
        Tangent of half the field of view.
    extent : tuple of float
        Tangents of half the image's vertical and horizontal field of view.
    """

    rotation: np.ndarray
    tangent: float
    extent: tuple[float, float]

    @classmethod
    def around(
        cls, box: tuple[int, int, int, int], shape: tuple[int, int], fov: float, margin: float
    ) -> Crop:
        """Return the camera that looks at the centre of a box.

        Parameters
        ----------
        box : tuple of int
            First row, last row + 1, first column, last column + 1.
        shape : tuple of int
            Height and width of the image.
        fov : float
            Field of view along the image's longer side, degrees.
        margin : float
            Side of the crop in larger sides of the box.
        """
        scale = math.tan(math.radians(fov) / 2) / max(shape)
        rows, columns = (scale * (2.0 * np.array(box) - np.repeat(shape, 2))).reshape(2, 2)
        forward = np.array([columns.mean(), rows.mean(), 1.0])
        forward /= np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        corners = np.array([[x, y, 1.0] for x in columns for y in rows]) @ rotation.T
        tangent = margin * float(np.abs(corners[:, :2] / corners[:, 2:]).max())
        return cls(rotation, tangent, (scale * shape[0], scale * shape[1]))

    def resampled(self, grid: np.ndarray, size: int) -> np.ndarray:
        """Return means of a grid over the crop's pixels: ``(h, w, C) → (size, size, C)``.

        The grid's equal cells cover the image. Pixels are NaN if less than half of them lies in
        cells that are not NaN.
        """
        known = ~np.isnan(grid).any(axis=-1, keepdims=True)
        cells = np.concatenate([np.where(known, grid, 0), known], axis=-1, dtype=np.float32)
        # Cells much smaller than the crop's pixels are averaged in blocks before they are sampled;
        # in its middle, a pixel spans this share of the image's height and width.
        span = self.tangent / (size * self.rotation[2, 2] ** 2 * np.array(self.extent))
        blocks = np.maximum(1, span * cells.shape[:2] * 2 / _SAMPLES).astype(int)
        places = self._places(size)
        inside = np.asarray(((places >= 0) & (places <= 1)).all(axis=-1), dtype=np.float64)
        places = places * (cells.shape[:2] / blocks) - 0.5
        cells = _block_means(cells, *blocks)
        means = _interpolation(places, inside / _SAMPLES**2, cells.shape[:2])
        total = (means @ cells.reshape(-1, cells.shape[2])).reshape(size, size, -1)
        seen = total[..., -1:] >= _SEEN
        return np.where(seen, total[..., :-1] / np.where(seen, total[..., -1:], 1.0), np.nan)

    def _places(self, size: int) -> np.ndarray:
        """Return where samples of the crop's pixels lie, as shares of the image's height and width.

        Returns
        -------
        ndarray, (size * size, samples, 2)
            Infinite behind the image's camera.
        """
        across = self.tangent * (np.arange(0.5, size * _SAMPLES) * 2 / (size * _SAMPLES) - 1)
        y, x = np.meshgrid(across, across, indexing="ij")
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.rotation
        ahead = rays[..., 2:] > 0
        tangents = rays[..., 1::-1] / np.where(ahead, rays[..., 2:], 1.0)
        shares = np.where(ahead, (tangents / self.extent + 1) / 2, np.inf)
        samples = shares.reshape(size, _SAMPLES, size, _SAMPLES, 2).swapaxes(1, 2)
        return samples.reshape(size * size, -1, 2)


def body_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return the first row, last row + 1, first column and last column + 1 of the body in a mask.

    Specks of less than 2 % of the largest part do not count.

    Parameters
    ----------
    mask : ndarray, (H, W)
        Share of each pixel that is the body, or NaN.

    Raises
    ------
    ValueError
        If there are several large parts, so that the mask may be of several bodies.
    """
    top, bottom, left, right = _bounds(mask >= 0.5)
    if max(bottom - top, right - left) < _SMALLEST:
        raise ValueError(
            f"mask must show a body of at least {_SMALLEST} pixels, got "
            f"{bottom - top} x {right - left}"
        )
    body = mask[top:bottom, left:right] >= 0.5
    unknown = np.isnan(mask[top:bottom, left:right])
    step = -(-max(body.shape) // _LABELLED)
    shares = _block_means(np.stack([body, unknown], axis=-1).astype(np.float32), step, step)
    coarse = shares[..., 0] > 0
    # Parts with a narrow gap or unknown pixels between them are one.
    outside = ~(coarse | (shares[..., 1] > 0))
    near = ndimage.distance_transform_edt(outside) <= _GAP / 2 * max(coarse.shape)
    labels, _ = ndimage.label(near)
    areas = np.bincount(labels[coarse], shares[coarse, 0])
    large = int((areas >= _ANIMAL * areas.max()).sum())
    if large > 1:
        raise ValueError(
            f"mask must show one body, got {large} large parts; give one mask per body, or an "
            "array with NaN where something hides parts of one"
        )
    counted = coarse & (areas >= _SPECK * areas.max())[labels]
    first_row, last_row, first_column, last_column = (step * bound for bound in _bounds(counted))
    inner = _bounds(body[first_row:last_row, first_column:last_column])
    top, left = top + first_row, left + first_column
    return top + inner[0], top + inner[1], left + inner[2], left + inner[3]


def _bounds(body: np.ndarray) -> tuple[int, int, int, int]:
    """Return the first and last row and column of the true entries, the last ones plus 1."""
    rows, columns = (np.flatnonzero(body.any(axis=axis)) for axis in (1, 0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def _block_means(cells: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return means over blocks of cells; incomplete blocks at the ends are completed by zeros."""
    if rows == columns == 1:
        return cells
    height, width, channels = cells.shape
    cells = np.pad(cells, ((0, -height % rows), (0, -width % columns), (0, 0)))
    blocks = cells.reshape(len(cells) // rows, rows, -1, columns, channels)
    means: np.ndarray = blocks.mean(axis=(1, 3))
    return means


def _interpolation(
    places: np.ndarray, weights: np.ndarray, shape: tuple[int, int]
) -> sparse.csr_array:
    """Return the matrix of weighted sums of bilinear interpolations on a grid.

    Parameters
    ----------
    places : ndarray, (pixels, samples, 2)
        Rows and columns of the samples of each pixel, in cells; cell centres are integers. Those
        beyond the outer centres have the values there.
    weights : ndarray, (pixels, samples)
        Weights of the samples.
    shape : tuple of int
        Rows and columns of the grid.

    Returns
    -------
    sparse array, (pixels, rows * columns)
    """
    last = np.array(shape) - 1
    places = np.clip(places, 0, last)
    first = places.astype(np.int32)
    corners = (first, np.minimum(first + 1, last))
    shares = (1 - (places - first), places - first)
    pixels = np.broadcast_to(np.arange(len(places))[:, None], weights.shape)
    rows, cells, entries = [], [], []
    for down in (0, 1):
        for across in (0, 1):
            rows.append(pixels)
            cells.append(corners[down][..., 0] * shape[1] + corners[across][..., 1])
            entries.append(weights * shares[down][..., 0] * shares[across][..., 1])
    indices = (np.ravel(rows), np.ravel(cells))
    return sparse.coo_array((np.ravel(entries), indices), (len(places), np.prod(shape))).tocsr()

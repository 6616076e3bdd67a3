"""Crops against the geometry of their cameras, formats of images and masks, and bad input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from probmotion.io.errors import MotionFileError
from probmotion.models.images.image_files import read_image
from probmotion.models.images.observation import ImageObservation

SHAPE = H, W = (180, 240)
FOV = 60.0
MIDDLE, CORNER, CUT = (90, 120), (50, 185), (150, 20)  # (row, column) of the body's centre


def ellipse(row: float, column: float, down: float = 24, across: float = 36) -> np.ndarray:
    """Return an antialiased mask."""
    y, x = np.mgrid[: 4 * H, : 4 * W] / 4 + 0.125
    fine = ((y - row) / down) ** 2 + ((x - column) / across) ** 2 < 1
    return fine.reshape(H, 4, W, 4).mean(axis=(1, 3))


def extents(fov: float = FOV) -> np.ndarray:
    """Return tangents of half the vertical and half the horizontal field of view."""
    return np.tan(np.deg2rad(fov) / 2) * np.array(SHAPE) / max(SHAPE)


def centres(rows: int, columns: int) -> np.ndarray:
    """Return the rows and columns of the centres of a grid's cells, from 0 to 1."""
    grid = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    places: np.ndarray = (np.stack(grid, axis=-1) + 0.5) / [rows, columns]
    return places


def in_image(observation: ImageObservation) -> np.ndarray:
    """Return where centres of the crop's pixels lie in the image, from 0 to 1, (S, S, 2)."""
    tangents = (2 * centres(observation.size, observation.size) - 1) * observation.tangent[0]
    rays = np.concatenate([tangents[..., ::-1], np.ones_like(tangents[..., :1])], axis=-1)
    camera = np.linalg.solve(observation.rotation[0], rays[..., None])[..., 0]
    places: np.ndarray = (camera[..., 1::-1] / camera[..., 2:] / extents() + 1) / 2
    return places


def solid_angles(extent: np.ndarray, rows: int, columns: int) -> np.ndarray:
    y, x = np.moveaxis((2 * centres(rows, columns) - 1) * extent, -1, 0)
    cell = 4 * extent[0] * extent[1] / (rows * columns)
    angles: np.ndarray = cell * (1 + x**2 + y**2) ** -1.5
    return angles


@pytest.mark.parametrize("centre", [MIDDLE, CORNER, CUT])
def test_crops_are_perspective_images_of_a_virtual_camera(centre: tuple[int, int]) -> None:
    """Colours and features that encode places in the image are those that the cameras imply."""
    places = np.concatenate([centres(H, W), np.full((H, W, 1), 0.3)], axis=-1)
    mask = ellipse(*centre)
    grid = centres(18, 24)
    seen = ImageObservation.read(places, mask, features=grid, fov=FOV, size=96, margin=1.5)
    assert seen.rgb is not None
    assert seen.features is not None
    expected = in_image(seen)
    # Distance from the image's border, in the image's height or width.
    depth = (0.5 - abs(expected - 0.5)).min(axis=-1)
    sure = depth > 0.01
    assert (np.isnan(seen.mask[0]) != (depth < 0)).mean() < 0.002
    assert np.isfinite(seen.mask[0])[sure].all()
    assert np.isnan(seen.rgb[0])[depth < -0.01].all()
    assert (np.isnan(seen.mask[0]) == np.isnan(seen.features[0, ..., 0])).all()
    np.testing.assert_allclose(seen.rgb[0, sure, :2], expected[sure], atol=1e-3)
    np.testing.assert_allclose(seen.rgb[0, sure, 2], 0.3, atol=1e-6)
    covered = depth > 0.6 / 18  # half a cell and half a pixel
    np.testing.assert_allclose(seen.features[0, covered], expected[covered], atol=1e-3)
    # No roll, and a body in the middle.
    np.testing.assert_allclose(seen.rotation[0, 0, 1], 0, atol=1e-12)
    if centre != CUT:
        np.testing.assert_allclose(expected[47:49, 47:49].mean((0, 1)) * SHAPE, centre, atol=0.6)
        reach = abs(np.argwhere(seen.mask[0] >= 0.5) - 47.5).max()
        assert reach == pytest.approx(48 / 1.5, abs=2)
    assert seen.truncated.tolist() == [centre == CUT]


@pytest.mark.parametrize("size", [16, 64, 200])
@pytest.mark.parametrize("centre", [MIDDLE, CORNER])
def test_crops_preserve_the_solid_angle_of_the_body(centre: tuple[int, int], size: int) -> None:
    mask = ellipse(*centre)
    seen = ImageObservation.read(np.zeros(SHAPE), mask, fov=FOV, size=size)
    before = (mask * solid_angles(extents(), H, W)).sum()
    angles = solid_angles(seen.tangent.repeat(2), size, size)
    assert np.nansum(seen.mask[0] * angles) == pytest.approx(before, rel=3e-3)


def test_fine_patterns_are_averaged() -> None:
    board = (np.indices((1500, 2000)).sum(axis=0) % 2).astype(bool)
    mask = np.zeros(board.shape, bool)
    mask[400:1000, 900:1700] = True
    seen = ImageObservation.read(board, mask, size=32)
    assert seen.rgb is not None
    np.testing.assert_allclose(seen.rgb, 0.5, atol=0.02)


def saved(folder: Path, image: Image.Image, name: str = "image.png", **options: Any) -> Path:
    image.save(folder / name, **options)
    return folder / name


def palette_image(labels: np.ndarray) -> Image.Image:
    image = Image.fromarray(labels.astype(np.uint8), "P")
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    return image


BODY = (ellipse(*MIDDLE) >= 0.5).astype(np.uint8)
GREY = np.round(255 * centres(H, W)[..., 1]).astype(np.uint8)
COLOURS = np.stack([GREY, GREY.T.reshape(SHAPE), 255 - GREY], axis=-1)
ALPHA = np.dstack([COLOURS, 255 * BODY])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Image.fromarray(COLOURS), COLOURS),
        (lambda: Image.fromarray(ALPHA), COLOURS),
        (lambda: Image.fromarray(GREY), np.dstack([GREY] * 3)),
        (lambda: Image.fromarray(GREY.astype(np.uint16) * 257), np.dstack([GREY] * 3)),
        (lambda: Image.fromarray(GREY).convert("LA"), np.dstack([GREY] * 3)),
        (lambda: Image.fromarray(255 * BODY).convert("1"), np.dstack([255 * BODY] * 3)),
        (lambda: palette_image(BODY), np.dstack([128 * BODY, 0 * BODY, 0 * BODY])),
    ],
    ids=["RGB", "RGBA", "L", "I;16", "LA", "1", "P"],
)
def test_formats_of_images(
    tmp_path: Path, make: Callable[[], Image.Image], expected: np.ndarray
) -> None:
    read = ImageObservation.read(saved(tmp_path, make()), BODY, size=64)
    given = ImageObservation.read(expected / 255, BODY, size=64)
    assert read.rgb is not None
    np.testing.assert_allclose(read.rgb, given.rgb, atol=1e-6)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Image.fromarray(BODY),
        lambda: Image.fromarray(255 * BODY),
        lambda: Image.fromarray(BODY.astype(np.uint16) * 65535),
        lambda: Image.fromarray(np.dstack([255 * BODY] * 3)),
        lambda: Image.fromarray(255 * BODY).convert("1"),
        lambda: palette_image(BODY),
    ],
    ids=["0 and 1", "0 and 255", "16 bits", "RGB", "1", "labels"],
)
def test_formats_of_masks(tmp_path: Path, make: Callable[[], Image.Image]) -> None:
    read = ImageObservation.read(COLOURS, saved(tmp_path, make()), size=64)
    given = ImageObservation.read(COLOURS, BODY.astype(np.float64), size=64)
    np.testing.assert_allclose(read.mask, given.mask, atol=1e-6)


def test_the_opacity_is_the_default_mask(tmp_path: Path) -> None:
    read = ImageObservation.read(saved(tmp_path, Image.fromarray(ALPHA)))
    np.testing.assert_array_equal(read.mask, ImageObservation.read(COLOURS, BODY).mask)
    with pytest.raises(ValueError, match="mask must be given, since"):
        ImageObservation.read(COLOURS)


def test_clips_are_lists_of_images(tmp_path: Path) -> None:
    masks = [ellipse(*CORNER), ellipse(*MIDDLE, 40, 20)]
    images, grids = [COLOURS, GREY], []
    for name, grid in (("a.npz", centres(9, 12)), ("b.npz", 1 - centres(9, 12))):
        np.savez(tmp_path / name, grid)
        grids.append(tmp_path / name)
    clip = ImageObservation.read(images, masks, features=grids, fov=FOV, size=48)
    assert (clip.images, clip.size) == (2, 48)
    for frame, sources in enumerate(zip(images, masks, grids, strict=True)):
        image, mask, features = sources
        one = ImageObservation.read(image, mask, features=features, fov=FOV, size=48)
        for name in ("mask", "rgb", "features", "tangent", "rotation"):
            np.testing.assert_array_equal(getattr(clip, name)[frame], getattr(one, name)[0])


def parts(gap: int, second: int, filled: float = 0.0) -> np.ndarray:
    """Return a mask of a rectangle 60 x 80 and another of a height at a distance to the right."""
    mask = np.zeros(SHAPE)
    mask[20:80, 20:100] = 1
    mask[20 : 20 + second, 100 + gap : 180 + gap] = 1
    mask[20:80, 100 : 100 + gap] = filled
    return mask


def test_several_bodies_are_refused_but_not_parts_of_one() -> None:
    behind_pole = parts(gap=6, second=60)
    behind_fence = parts(gap=30, second=60, filled=np.nan)
    for mask in (behind_pole, behind_fence, parts(gap=30, second=14)):
        ImageObservation.read(COLOURS, mask, size=16)
    with pytest.raises(ValueError, match="must show one body, got 2 large parts; give one mask"):
        ImageObservation.read(COLOURS, parts(gap=30, second=60))
    with pytest.raises(ValueError, match="got 2 large parts"):
        ImageObservation.read(COLOURS, parts(gap=30, second=16))


def test_specks_do_not_change_the_crop() -> None:
    mask = ellipse(*CORNER, 12, 18)
    speckled = mask.copy()
    speckled[170:173, 5:8] = 1
    clean, seen = (ImageObservation.read(COLOURS, each, size=32) for each in (mask, speckled))
    np.testing.assert_array_equal(seen.mask, clean.mask)
    # Larger parts do.
    speckled[160:173, 5:18] = 1
    assert ImageObservation.read(COLOURS, speckled, size=32).tangent > 2 * clean.tangent


def damaged(folder: Path, change: Callable[[bytes], bytes]) -> Path:
    path = saved(folder, Image.fromarray(COLOURS))
    path.write_bytes(change(path.read_bytes()))
    return path


def rotated(folder: Path) -> Path:
    exif = Image.Exif()
    exif[0x0112] = 6
    return saved(folder, Image.fromarray(COLOURS), "image.jpg", exif=exif)


def animation(folder: Path) -> Path:
    frames = [Image.fromarray(COLOURS), Image.fromarray(255 - COLOURS)]
    return saved(folder, frames[0], "image.gif", save_all=True, append_images=frames[1:])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: damaged(folder, lambda content: b""), "expected an undamaged image"),
        (lambda folder: damaged(folder, lambda content: content[:-3000]), "undamaged image"),
        (lambda folder: damaged(folder, lambda content: b"text" + content), "undamaged image"),
        (lambda folder: folder, "expected a readable image file"),
        (rotated, "expected an upright image, got EXIF orientation 6"),
        (animation, "expected a single image, got 2; give a list of files"),
    ],
)
def test_bad_files_are_one_sentence(
    tmp_path: Path, make: Callable[[Path], Path], words: str
) -> None:
    path = make(tmp_path)
    for sources in ((path, BODY), (COLOURS, path)):
        with pytest.raises(MotionFileError, match=words) as error:
            ImageObservation.read(*sources)
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match="absent"):
        ImageObservation.read(tmp_path / "absent.png", BODY)


def test_a_changed_byte_of_a_png_is_detected(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    pixels[8:] = pixels[0]
    path = saved(tmp_path, Image.fromarray(pixels))
    content = path.read_bytes()
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        try:
            read, _ = read_image(path)
        except MotionFileError:
            continue
        np.testing.assert_array_equal(np.round(255 * read), pixels)


@pytest.mark.parametrize("limit", [100, H * W - 1])
def test_files_that_decode_to_many_pixels_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    """Pillow raises an error above twice its limit, and only warns above the limit."""
    path = saved(tmp_path, Image.fromarray(COLOURS))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
    with pytest.raises(MotionFileError, match="expected an undamaged image"):
        ImageObservation.read(path, BODY)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (0 * BODY, "must show the body, got no pixel of it"),
        (0 * BODY + 1, "must show the background, got the body in every pixel"),
        (128 * BODY, "must reach its full value in the body, got at most 0.502"),
        (2 * BODY, "must show one body, got labels 0 to 2; give one that is 1 or 255"),
        (BODY[1:], r"the image's height and width \(180, 240\), got shape \(179, 240\)"),
        (np.dstack([BODY] * 3), "got shape"),
        (BODY * 7.0, "must be from 0 to 1, got 0 to 7"),
        (np.where(BODY, np.inf, 0), "must be from 0 to 1"),
        (BODY.astype(str), "must be uint8, uint16, bool, or floats"),
        (np.eye(H, W) * [np.arange(W) < 5], "body of at least 8 pixels, got 5 x 5"),
        (None, "mask must be given, since the image has no transparency"),
    ],
)
def test_bad_masks(mask: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ImageObservation.read(COLOURS, mask)
    with pytest.raises(ValueError, match=f"^frame 0: .*{words}"):
        ImageObservation.read([COLOURS], None if mask is None else [mask])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: palette_image(np.arange(H * W).reshape(SHAPE) % 3), "labels 0 and 1, got 0, 1, 2"),
        (lambda: Image.fromarray(COLOURS), "mask must be grey, got colours"),
        (lambda: Image.fromarray(ALPHA), "mask must be opaque, got transparent pixels"),
        (lambda: Image.fromarray(BODY[:-9]), "the image's height and width"),
        (lambda: Image.fromarray(255 * parts(30, 60).astype(np.uint8)), "got 2 large parts"),
    ],
)
def test_bad_mask_files_are_named(
    tmp_path: Path, make: Callable[[], Image.Image], words: str
) -> None:
    path = saved(tmp_path, make())
    with pytest.raises(MotionFileError, match=f"^{path}: .*{words}"):
        ImageObservation.read([COLOURS], [path])


GRID = np.ones((9, 12, 4))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"a": GRID, "b": GRID}, r"expected one array of features, got 2 \(a, b\)"),
        ({}, "expected one array of features, got 0"),
        ({"a": GRID[0]}, "features must have shape"),
        ({"a": GRID[:0]}, "features must not be empty"),
        ({"a": GRID.swapaxes(0, 2).repeat(16, axis=0)}, ".* of a grid over the image of 180 x 240"),
        ({"a": GRID * np.nan}, "features must be finite"),
        ({"a": GRID * 1e300}, "features must be finite"),
        ({"a": GRID.astype(str)}, "features must be real numbers"),
        ({"a": GRID.astype(object)}, "expected numbers or strings"),
    ],
)
def test_bad_features(tmp_path: Path, arrays: dict[str, np.ndarray], words: str) -> None:
    path = tmp_path / "features.npz"
    np.savez(path, **arrays)
    with pytest.raises(MotionFileError, match=f"^{path}: {words}"):
        ImageObservation.read(COLOURS, BODY, features=path)
    path.write_bytes(b"no archive")
    with pytest.raises(MotionFileError, match=f"^{path}: expected an npz archive"):
        ImageObservation.read(COLOURS, BODY, features=path)


@pytest.mark.parametrize(
    ("image", "options", "words"),
    [
        (COLOURS, {"fov": 0}, "fov must be a finite number above 0"),
        (COLOURS, {"fov": 150}, "fov must be at most 120 degrees, got 150"),
        (COLOURS, {"size": 4}, "size must be an integer of at least 8"),
        (COLOURS, {"margin": 1.0}, "margin must be at least 1.1"),
        (COLOURS[..., :2], {}, r"image must have shape \(H, W\)"),
        (COLOURS.astype(int), {}, "image must be uint8"),
        (COLOURS / 250, {}, "image must be from 0 to 1, got 0"),
        (COLOURS * np.nan, {}, "image must be finite"),
        (7, {}, "image must be a file or an array, got int"),
        (COLOURS, {"mask": [BODY]}, "mask must be a single one for a single image, got a list"),
        (COLOURS, {"features": GRID[..., None]}, "features must have shape"),
        ([], {"mask": []}, "image must contain at least one image"),
        ([COLOURS] * 2, {"mask": [BODY]}, "mask must be a list of 2 for 2 images, got 1"),
        ([COLOURS], {}, "mask must be a list of 1 for 1 images"),
        ([COLOURS], {"mask": [None]}, "mask must be a file or an array, got NoneType"),
        (
            [COLOURS, COLOURS[:-1]],
            {"mask": [BODY, BODY[:-1]]},
            r"frame 1: image must have the size \(180, 240\) of frame 0",
        ),
        (
            [COLOURS] * 2,
            {"mask": [BODY] * 2, "features": [GRID, GRID[..., :3]]},
            "frame 1: features must have the 4 channels of frame 0, got 3",
        ),
    ],
)
def test_other_bad_input(image: Any, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ImageObservation.read(image, **({"mask": BODY} | options))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mask": np.zeros((1, 8, 8))}, "mask must show the body, got no pixel of it in frame 0"),
        ({"mask": np.ones((1, 8, 8))}, "mask must show the background"),
        ({"mask": np.eye(8)}, "mask must have shape"),
        ({"mask": np.eye(8, 9)[None]}, "mask must be of square crops"),
        ({"mask": 2 * np.eye(8)[None]}, "mask must be from 0 to 1, or NaN, got 0 to 2"),
        ({"rgb": np.zeros((2, 8, 8, 3))}, "rgb must have shape"),
        ({"rgb": np.full((1, 8, 8, 3), -1.0)}, "rgb must be from 0 to 1"),
        ({"features": np.zeros((1, 8, 8))}, "features must have shape"),
        ({"features": np.full((1, 8, 8, 2), np.inf)}, "features must be finite"),
        ({"tangent": np.zeros(1)}, "tangent must be above 0"),
        ({"tangent": np.ones(2)}, "tangent must have shape"),
        ({"rotation": 1.1 * np.eye(3)[None]}, "rotation must be of rotation matrices"),
        ({"rotation": -np.eye(3)[None]}, "rotation must be of rotation matrices"),
    ],
)
def test_fields_are_checked(change: dict[str, np.ndarray], words: str) -> None:
    fields = {
        "mask": np.eye(8)[None],
        "rgb": None,
        "features": None,
        "tangent": np.ones(1),
        "rotation": np.eye(3)[None],
    }
    ImageObservation(**fields)
    with pytest.raises(ValueError, match=words):
        ImageObservation(**fields | change)

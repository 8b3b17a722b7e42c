"""Photos are read upright; implausible EXIF focal lengths are ignored."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from cadalign import FocalPrior
from cadalign.errors import DataError, InputError, quote
from cadalign.io.images import open_photo, photo_size, read_photo

TAGS = {
    "focal": 0x920A,
    "equivalent": 0xA405,
}
DIAGONAL_MM = math.hypot(36, 24)


def write_photo(
    path: Path,
    *,
    size: tuple[int, int] = (640, 480),
    turn: int | None = None,
    **tags: Any,
) -> Path:
    """A photo with a red left upper corner in its file, and EXIF tags."""
    pixels = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    pixels[: size[1] // 4, : size[0] // 4] = (255, 0, 0)
    image = Image.fromarray(pixels)
    exif = image.getexif()
    if turn is not None:
        exif[0x0112] = turn
    exif[0x8769] = {TAGS[name]: value for name, value in tags.items()}
    image.save(path, exif=exif, quality=95)
    return path


# --- upright ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("turn", "size", "corner"),
    [
        (None, (640, 480), (0, 0)),
        (1, (640, 480), (0, 0)),
        (3, (640, 480), (1, 1)),
        (6, (480, 640), (1, 0)),
        (8, (480, 640), (0, 1)),
    ],
)
def test_photos_are_turned_upright(
    tmp_path: Path, turn: int | None, size: tuple[int, int], corner: tuple[int, int]
) -> None:
    path = write_photo(tmp_path / "photo.jpg", turn=turn)
    pixels = read_photo(path)
    assert photo_size(path) == size == (pixels.shape[1], pixels.shape[0])
    x, y = (10 if at == 0 else length - 10 for at, length in zip(corner, size, strict=True))
    assert pixels[y, x, 0] > 200
    assert pixels[size[1] // 2, size[0] // 2].max() < 50


@pytest.mark.parametrize("kind", ["RGBA", "L", "P", "I;16"])
def test_any_kind_of_picture_becomes_rgb(tmp_path: Path, kind: str) -> None:
    Image.new(kind, (20, 10)).save(tmp_path / "picture.png")
    assert read_photo(tmp_path / "picture.png").shape == (10, 20, 3)


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_greys_of_16_bits_keep_their_contrast(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"photo.{ending}"
    greys = np.arange(0, 2**16, 2**8, dtype=np.uint16).reshape(16, 16)
    Image.fromarray(greys).save(path)
    np.testing.assert_array_equal(read_photo(path), np.repeat(greys[..., None] >> 8, 3, axis=2))


def test_photo_of_too_many_pixels_says_how_many_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "photo.png"
    Image.new("L", (2000, 1100)).save(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1_000_000)
    with pytest.raises(DataError) as caught:
        photo_size(path)
    assert str(caught.value) == f"{path}: the image has more than 2 megapixels; make it smaller"


@pytest.mark.parametrize("read", [read_photo, photo_size, FocalPrior.from_exif])
@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe1"])
def test_file_that_is_no_photo_is_refused(
    tmp_path: Path, read: Callable[[Path], object], content: bytes
) -> None:
    path = tmp_path / "photo.jpg"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: not an image that can be read (")


@pytest.mark.parametrize("name", ["photo.jpg", "photo.png"])
def test_photo_cut_short_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (99, 99, 3), dtype=np.uint8)).save(
        path
    )
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match=r"photo\.\w+: not an image that can be read \("):
        read_photo(path)


@pytest.mark.parametrize("read", [read_photo, photo_size, FocalPrior.from_exif])
def test_missing_photo_and_folder_are_refused(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    with pytest.raises(DataError) as caught:
        read(tmp_path / "nothing.jpg")
    assert str(caught.value) == f"{tmp_path / 'nothing.jpg'}: no such file"
    with pytest.raises(DataError, match=r"cannot be read \(Is a directory\)"):
        read(tmp_path)


@pytest.mark.long
def test_pixels_that_the_file_cannot_hold_are_refused(tmp_path: Path) -> None:
    large, small = tmp_path / "large.png", tmp_path / "small.png"
    Image.new("1", (12_000, 12_000)).save(large)
    Image.new("1", (4000, 3000)).save(small)
    for read in (read_photo, photo_size, FocalPrior.from_exif):
        with pytest.raises(DataError, match="12000 x 12000 pixels in"):
            read(large)
        read(small)


def test_errors_in_the_block_are_not_reported_as_errors_of_the_photo(tmp_path: Path) -> None:
    path = write_photo(tmp_path / "photo.jpg")
    with pytest.raises(ZeroDivisionError), open_photo(path):
        raise ZeroDivisionError


# --- focal length -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tags", "focal"),
    [
        ({"equivalent": 26}, 26 / DIAGONAL_MM * 800),
        ({"equivalent": 26, "turn": 6}, 26 / DIAGONAL_MM * 800),
        ({"equivalent": 26, "focal": 4.25}, 26 / DIAGONAL_MM * 800),
    ],
)
def test_focal_length_is_read(tmp_path: Path, tags: dict[str, Any], focal: float) -> None:
    prior = FocalPrior.from_exif(write_photo(tmp_path / "photo.jpg", **tags))
    assert prior is not None
    assert prior.focal == pytest.approx(focal, rel=1e-4)
    assert prior.relative_sigma == 0.05


@pytest.mark.parametrize("tags", [{}, {"equivalent": 0}, {"focal": 4.0}])
def test_photo_without_focal_length_gives_no_prior(
    tmp_path: Path, tags: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    assert FocalPrior.from_exif(write_photo(tmp_path / "photo.jpg", **tags)) is None
    assert not caplog.records


def test_implausible_focal_length_is_ignored_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = "the EXIF focal length of 1.109e+06 px is implausible and ignored"
    path = write_photo(tmp_path / "photo.jpg", equivalent=60000)
    with caplog.at_level(logging.WARNING, logger="cadalign"):
        assert FocalPrior.from_exif(path) is None
    assert [record.getMessage() for record in caplog.records] == [f"{path}: {text}"]


@pytest.mark.parametrize(
    "value", [0, -3.0, math.nan, math.inf, "900", None, True, 10**400, np.complex128(1 + 2j)]
)
def test_invalid_priors_are_refused(value: Any) -> None:
    with pytest.raises(InputError) as caught:
        FocalPrior(value)
    assert str(caught.value) == f"focal_prior.focal: {quote(value)} is not positive and finite"
    with pytest.raises(InputError, match=r"focal_prior\.relative_sigma: .* is not positive"):
        FocalPrior(900.0, value)

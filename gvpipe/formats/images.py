"""Photographs from files nobody vouches for: bytes in, RGB pixels or a reason out.

What becomes of pixels that are not 8-bit RGB: 16-bit values keep their upper 8 bits; grey, palette
and one-bit images are spread over three channels; alpha is dropped (TIFF: composited on black);
CMYK is converted without a colour profile; of several frames the first counts. Orientation tags
are recorded and never applied: calibration speaks of the sensor's own pixels.
"""

import hashlib
import io
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gvpipe.core.types import Image, Rejected
from gvpipe.formats.files import read_regular_file
from gvpipe.formats.raster import png_is_whole

MAX_FILE_BYTES = 256 << 20
"""Largest file read."""

MAX_PIXELS = 64_000_000
"""Largest image decoded: what its header says is checked first."""

IMAGE_EXTENSIONS = frozenset(
    {".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".dib", ".webp", ".ppm"}
    | {".pgm", ".pbm", ".pnm", ".heic", ".heif", ".avif", ".gif", ".jp2"}
)
"""Endings under which a file counts as an image, even if it turns out to be a bad one."""

_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "PPM")
_WIDE_MODES = frozenset({"F", "I", "LAB"})  # TIFF pixels that OpenCV misreads or refuses
_ORIENTATION_TAG = 274
_HEADER_LOCK = threading.Lock()  # warning filters are one for all threads


@dataclass(frozen=True)
class DecodedImage:
    """A photograph and where its bytes came from.

    Attributes
    ----------
    pixels : (H, W, 3) uint8
        RGB, in the sensor's orientation.
    sha256 : str
        Of the file's bytes, hexadecimal.
    size_bytes : int
        Of the file.
    exif_orientation : int or None
        As tagged, even if out of its range 1 to 8; None if there is no tag.
    """

    pixels: Image
    sha256: str
    size_bytes: int
    exif_orientation: int | None


@dataclass(frozen=True)
class Header:
    """What an image file says of itself."""

    format: str
    mode: str
    width: int
    height: int
    orientation: int | None


def read_image(
    path: Path, max_pixels: int = MAX_PIXELS, *, known_sha256: str = ""
) -> DecodedImage | Rejected:
    """Read and decode one image file.

    Parameters
    ----------
    path : Path
        Any name; a link is followed. Never blocks on a pipe or a device.
    max_pixels : int
        Images whose header announces more are not decoded.
    known_sha256 : str
        Of bytes that this function has read before: that they are whole is not looked at again.

    Returns
    -------
    image : DecodedImage or Rejected
    """
    raw = read_regular_file(path, MAX_FILE_BYTES)
    if isinstance(raw, Rejected):
        return raw
    header = read_header(raw, max_pixels)
    if isinstance(header, Rejected):
        return header
    digest = hashlib.sha256(raw).hexdigest()
    if digest != known_sha256 and not _is_whole(raw, header.format):
        return Rejected(f"{header.format} data are truncated or corrupt")
    try:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        bgr = cv2.imdecode(np.frombuffer(raw, np.uint8), flags)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from error  # says nothing about the image
        return Rejected(f"{header.format} cannot be decoded: {error.err}")
    if bgr is None:
        return Rejected(f"{header.format} data are truncated or corrupt")
    height, width = bgr.shape[:2]
    if (width, height) != (header.width, header.height):
        said = f"{header.width}x{header.height}"
        return Rejected(f"{header.format} header says {said}, data hold {width}x{height}")
    pixels = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    return DecodedImage(pixels, digest, len(raw), header.orientation)


def is_image_file(path: Path) -> bool:
    """Whether a file counts as an image: by its ending, or else by its first bytes."""
    if path.suffix.lower() in IMAGE_EXTENSIONS:
        return True
    raw = read_regular_file(path, MAX_FILE_BYTES, first=32)
    if isinstance(raw, Rejected):
        return False
    magic = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*")
    return raw.startswith(magic) or (raw[:4] == b"RIFF" and raw[8:12] == b"WEBP")


def read_header(raw: bytes, max_pixels: int = MAX_PIXELS) -> Header | Rejected:
    """Read size, kind and orientation of an image, without decoding it."""
    from PIL import Image as Pillow

    if not raw:
        return Rejected("is empty")
    if raw[4:8] == b"ftyp" and raw[8:12] in (b"heic", b"heix", b"mif1", b"avif", b"hevc"):
        return Rejected("is HEIC or AVIF, which is not read; convert it to JPEG or PNG")
    with _HEADER_LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            image = Pillow.open(io.BytesIO(raw), formats=_FORMATS)
        except Pillow.DecompressionBombError:
            return Rejected(f"is larger than {max_pixels / 1e6:g} Mpx")
        except Exception:  # a parser of hostile bytes may raise anything
            return Rejected("is not a sound JPEG, PNG, TIFF, BMP, WebP or PNM file")
        kind = "JPEG" if image.format == "MPO" else str(image.format)  # JPEGs in a row
        width, height = image.size
        orientation = _orientation(image)
    if width * height > max_pixels:
        return Rejected(f"is {width}x{height}, larger than {max_pixels / 1e6:g} Mpx")
    if kind == "TIFF" and image.mode in _WIDE_MODES:
        return Rejected(f"is a TIFF with {image.mode} pixels; expected 8 or 16 bits of grey or RGB")
    if kind == "TIFF" and orientation not in (None, 1):
        return Rejected(f"is a TIFF with orientation tag {orientation}, which decoders apply")
    return Header(kind, image.mode, width, height, orientation)


def _is_whole(raw: bytes, kind: str) -> bool:
    """Whether a file's data go on to their end and are sound.

    OpenCV, depending on its version, returns what it has of a PNG that stops early, and of
    damaged JPEG and TIFF data; Pillow refuses those, but takes a PNG without its end.
    """
    if kind == "PNG":
        return png_is_whole(raw)
    if kind not in ("JPEG", "TIFF"):
        return True
    from PIL import Image as Pillow

    try:
        Pillow.open(io.BytesIO(raw), formats=(kind,)).load()
    except MemoryError:
        raise
    except Exception:  # a parser of hostile bytes may raise anything
        return False
    return True


def _orientation(image: object) -> int | None:
    """Orientation tag of an opened Pillow image, None if there is none or EXIF is corrupt."""
    from PIL import Image as Pillow
    from PIL.TiffImagePlugin import TiffImageFile

    try:
        if isinstance(image, TiffImageFile):
            value = image.tag_v2.get(_ORIENTATION_TAG)
        else:
            exif = Pillow.Exif()
            exif.load(image.info.get("exif", b""))  # type: ignore[attr-defined]
            value = exif.get(_ORIENTATION_TAG)
    except Exception:  # a parser of hostile bytes may raise anything
        return None
    return int(value) if isinstance(value, int) else None

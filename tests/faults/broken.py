"""Forty files among photographs that cannot be used, each for a reason of its own."""

import io
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

Maker = Callable[[Path], object]


def encoded(picture: Image.Image, kind: str, **options: object) -> bytes:
    """Encode by Pillow."""
    stream = io.BytesIO()
    picture.save(stream, format=kind, **options)
    return stream.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    """One chunk of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, rows: int) -> bytes:
    """A black PNG that announces a size and holds so many rows."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes((3 * width + 1) * rows))
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", data), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def garbled(data: bytes, share: float, length: int = 200) -> bytes:
    """Overwrite a stretch of bytes."""
    at = int(len(data) * share)
    noise = np.random.default_rng(0).bytes(length)
    return data[:at] + noise + data[at + length :]


def lying_jpeg(data: bytes) -> bytes:
    """Announce twice the height."""
    at = data.index(b"\xff\xc0") + 5
    height = int.from_bytes(data[at : at + 2], "big")
    return data[:at] + (2 * height).to_bytes(2, "big") + data[at + 2 :]


def makers(picture: Image.Image) -> dict[str | bytes, bytes | Maker]:
    """Contents, or what to do, by file name."""
    jpeg, bmp = encoded(picture, "JPEG"), encoded(picture, "BMP")
    flawless = encoded(picture, "PNG")
    tiff = encoded(picture, "TIFF", compression="tiff_lzw")
    webp, ppm = encoded(picture, "WEBP"), encoded(picture, "PPM")
    small = picture.resize((64, 48))
    depth = Image.fromarray(np.zeros(np.asarray(picture).shape[:2], np.float32))
    turned = Image.Exif()
    turned[274] = 6
    width, height = picture.size
    return {
        "00 empty.png": b"",
        "01 first bytes.png": flawless[:8],
        "02 cut early.png": flawless[:200],
        "03 cut late.png": flawless[:-13],
        "04 no end.png": flawless[:-12],
        "05 flipped bit.png": garbled(flawless, 0.5, 1),
        "06 garbled.png": garbled(flawless, 0.5),
        "07 too few rows.png": png(width, height, height // 2),
        "08 no pixels.png": png(0, 0, 0),
        "09 bomb.png": png(60_000, 60_000, 4),
        "10 half cut.jpg": jpeg[: len(jpeg) // 2],
        "11 last byte missing.jpg": jpeg[:-1],
        "12 start only.jpg": jpeg[:2],
        "13 no tables.jpg": jpeg.replace(b"\xff\xdb", b"\xff\xfe"),
        "14 lying header.jpg": lying_jpeg(jpeg),
        "15 zeros.jpg": bytes(100_000),
        "16 half cut.bmp": bmp[: len(bmp) // 2],
        "17 half cut.tif": tiff[: len(tiff) // 2],
        "18 garbled.tif": garbled(tiff, 0.5),
        "19 turned.tif": encoded(picture, "TIFF", exif=turned),
        "20 distances.tiff": encoded(depth, "TIFF"),
        "21 half cut.webp": webp[: len(webp) // 2],
        "22 half cut.ppm": ppm[: len(ppm) // 2],
        "23 text.jpg": b"this is no picture\n" * 20,
        "24 page.png": b"<!doctype html><script>alert(1)</script>",
        "25 archive.png": b"PK\x03\x04" + bytes(200),
        "26 noise.png": np.random.default_rng(1).bytes(5000),
        "27 phone.heic": b"\0\0\0\x18ftypheic" + bytes(500),
        "28 drawing.gif": encoded(picture, "GIF"),
        "29 other size.png": encoded(small, "PNG"),
        "30 other size, 16 bits.png": encoded(small.convert("I;16"), "PNG"),
        "31 other size, cmyk.jpg": encoded(small.convert("CMYK"), "JPEG"),
        "32 pipe.png": lambda path: os.mkfifo(path),
        "33 loop.png": lambda path: path.symlink_to(path.name),
        "34 gone.png": lambda path: path.symlink_to("no such file.png"),
        "35 device.png": lambda path: path.symlink_to("/dev/zero"),
        b"36 \xff\xfe.png": b"bad",
        "37 line\nfeed \x1b[31m[red].png": b"bad",
        "-rf.png": b"bad",
        "39 " + "n" * 248 + ".png": b"bad",
    }


def add_broken_images(folder: Path) -> int:
    """Put forty unusable files beside the pictures in a folder; return how many."""
    good = sorted(folder.glob("*.*"))[0]
    with Image.open(good) as image:
        made = makers(image.convert("RGB"))
    for name, what in made.items():
        path = folder / (name if isinstance(name, str) else os.fsdecode(name))
        if isinstance(what, bytes):
            path.write_bytes(what)
        else:
            what(path)
    return len(made)

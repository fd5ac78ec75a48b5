"""Images nobody vouches for: each kind of bad file gives a reason, each good one its pixels."""

import io
import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from gvpipe.core.types import Rejected
from gvpipe.formats.images import DecodedImage, is_image_file, read_image
from gvpipe.formats.video import VideoReader

RED_LEFT = np.zeros((48, 64, 3), np.uint8)
RED_LEFT[:, :32, 0] = 200
RED_LEFT[:, 32:, 2] = 100


def encode(kind="PNG", mode=None, pixels=RED_LEFT, **options):
    image = Pillow.fromarray(pixels)
    buffer = io.BytesIO()
    (image.convert(mode) if mode else image).save(buffer, kind, **options)
    return buffer.getvalue()


@pytest.fixture
def read(tmp_path):
    def _read(raw, name="a.img", **options):
        path = tmp_path / name
        path.write_bytes(raw)
        return read_image(path, **options)

    return _read


def orientation(value):
    exif = Pillow.Exif()
    exif[274] = value
    return exif


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "BMP", "PPM"])
def test_lossless_formats_are_exact_and_rgb(kind, read):
    found = read(raw := encode(kind))
    assert isinstance(found, DecodedImage)
    np.testing.assert_array_equal(found.pixels, RED_LEFT)
    assert found.size_bytes == len(raw)
    assert found.exif_orientation is None


@pytest.mark.parametrize("kind", ["JPEG", "WEBP"])
def test_lossy_formats_are_close(kind, read):
    found = read(encode(kind, quality=95))
    assert isinstance(found, DecodedImage)
    assert abs(found.pixels[24, 10].astype(int) - [200, 0, 0]).max() <= 12


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize("value", [1, 3, 6, 8, 0, 9])
def test_orientation_is_recorded_and_not_applied(kind, value, read):
    found = read(encode(kind, exif=orientation(value)))
    assert isinstance(found, DecodedImage)
    assert found.pixels.shape == (48, 64, 3)
    assert found.pixels[24, 5, 0] > 150  # left is still red
    assert found.exif_orientation == value


def test_turned_tiff_is_refused_because_decoders_turn_it(read):
    assert isinstance(read(encode("TIFF", exif=orientation(1))), DecodedImage)
    found = read(encode("TIFF", exif=orientation(6)))
    assert isinstance(found, Rejected)
    assert "orientation tag 6" in found.reason


def test_sixteen_bits_keep_the_upper_eight(read):
    wide = np.full((48, 64), 40000, np.uint16)
    for kind in ("PNG", "TIFF"):
        found = read(encode(kind, pixels=wide))
        assert isinstance(found, DecodedImage)
        np.testing.assert_array_equal(found.pixels, 40000 >> 8)
    _, raw = cv2.imencode(".png", np.dstack([wide, wide // 2, wide // 4]))
    found = read(raw.tobytes())
    assert isinstance(found, DecodedImage)
    np.testing.assert_array_equal(found.pixels[0, 0], [10000 >> 8, 20000 >> 8, 40000 >> 8])


@pytest.mark.parametrize("mode", ["L", "1", "P", "LA", "RGBA"])
def test_other_png_modes_become_rgb(mode, read):
    found = read(encode("PNG", mode))
    assert isinstance(found, DecodedImage)
    assert found.pixels.shape == (48, 64, 3)
    expected = np.asarray(Pillow.fromarray(RED_LEFT).convert(mode).convert("RGB"))
    np.testing.assert_array_equal(found.pixels, expected)


def test_alpha_is_dropped(read):
    clear = np.dstack([RED_LEFT, np.zeros((48, 64), np.uint8)])
    found = read(encode("PNG", pixels=clear))
    assert isinstance(found, DecodedImage)
    np.testing.assert_array_equal(found.pixels, RED_LEFT)


@pytest.mark.parametrize("kind", ["JPEG", "TIFF"])
def test_cmyk_becomes_rgb(kind, read):
    found = read(encode(kind, "CMYK"))
    assert isinstance(found, DecodedImage)
    assert abs(found.pixels[24, 10].astype(int) - [200, 0, 0]).max() <= 12


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF", "BMP", "WEBP"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9, 1.0])
def test_truncated_files_are_refused(kind, share, read):
    raw = encode(kind, pixels=np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    found = read(raw[: min(int(len(raw) * share), len(raw) - 1)])
    assert isinstance(found, Rejected)


def test_empty_text_and_noise_are_refused(read):
    assert read(b"") == Rejected("is empty")
    assert "is not a sound JPEG" in read(b"hello" * 100).reason
    assert "HEIC" in read(b"\0\0\0\x18ftypheic" + b"\0" * 50).reason
    assert "is not a sound JPEG" in read(encode("GIF", "P")).reason


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png_of(width, height, rows):
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(rows)
    signature = b"\x89PNG\r\n\x1a\n"
    return signature + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(20000, 20000), (65000, 65000), (9000, 9000)])
def test_bombs_are_refused_by_their_header(size, read):
    found = read(png_of(*size, b"\0" * 1000))
    assert isinstance(found, Rejected)
    assert "larger than 64 Mpx" in found.reason


def test_the_size_gate_is_exact(read):
    assert isinstance(read(encode(), max_pixels=48 * 64), DecodedImage)
    assert "is 64x48, larger than" in read(encode(), max_pixels=48 * 64 - 1).reason


def test_a_header_that_lies_is_refused(read):
    found = read(png_of(640, 480, (b"\0" + b"\xff" * 192) * 48))
    assert isinstance(found, Rejected)


def test_a_file_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("gvpipe.formats.images.MAX_FILE_BYTES", 100)
    path = tmp_path / "a.png"
    path.write_bytes(encode())
    assert "at most 100 are read" in read_image(path).reason


def test_what_is_no_regular_file_never_blocks(tmp_path):
    pipe, loop, link = tmp_path / "p.jpg", tmp_path / "l.jpg", tmp_path / "ok.png"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    (tmp_path / "a").write_bytes(encode())
    link.symlink_to("a")
    (tmp_path / "pl.jpg").symlink_to(pipe)
    assert read_image(pipe) == Rejected("is not a regular file")
    assert read_image(tmp_path / "pl.jpg") == Rejected("is not a regular file")
    assert read_image(tmp_path) == Rejected("is not a regular file")
    assert "cannot be read" in read_image(loop).reason
    assert "cannot be read" in read_image(tmp_path / "none.jpg").reason
    assert isinstance(read_image(link), DecodedImage)


def test_what_the_kernel_makes_up_is_empty(tmp_path):
    (tmp_path / "a.png").symlink_to("/proc/self/status")
    (tmp_path / "a").symlink_to("/proc/self/status")
    assert read_image(tmp_path / "a.png") == Rejected("is empty")
    assert not is_image_file(tmp_path / "a")


@pytest.mark.parametrize("name", [b"\xff\xfe.png", b"a\nb.png", "\U0001f697.png".encode()])
def test_any_name_is_read(name, tmp_path):
    path = tmp_path / os.fsdecode(name)
    path.write_bytes(encode())
    assert isinstance(read_image(path), DecodedImage)


def test_content_decides_where_the_ending_says_nothing(tmp_path):
    for name, raw, expected in (
        ("a.jpg", b"no image", True),
        ("a.dat", encode("JPEG"), True),
        ("a", encode("WEBP"), True),
        ("notes.txt", b"text", False),
    ):
        (tmp_path / name).write_bytes(raw)
        assert is_image_file(tmp_path / name) is expected


@given(data=st.data())
@settings(deadline=None, max_examples=150)
def test_damaged_files_are_an_image_or_a_reason(data, tmp_path_factory):
    raw = bytearray(encode(data.draw(st.sampled_from(["PNG", "JPEG", "TIFF", "BMP", "WEBP"]))))
    for _ in range(data.draw(st.integers(1, 8))):
        raw[data.draw(st.integers(0, min(len(raw) - 1, 400)))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.img"
    path.write_bytes(raw)
    assert isinstance(read_image(path, max_pixels=10**6), DecodedImage | Rejected)


def write_video(path, count=6, size=(64, 48)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
    for k in range(count):
        writer.write(np.full((size[1], size[0], 3), (10, 20, 40 * k), np.uint8))
    writer.release()


def test_video_frames_are_numbered_from_0_and_rgb(tmp_path):
    write_video(tmp_path / "a.avi")
    with VideoReader(tmp_path / "a.avi") as video:
        assert (video.width, video.height, video.announced, video.reason) == (64, 48, 6, None)
        reds = [int(frame[0, 0, 0]) for frame in video]
        assert np.abs(np.array(reds) - 40 * np.arange(6)).max() <= 4
        for k in (3, 4, 1, 5, 0):  # forwards and back
            frame = video.read(k)
            assert isinstance(frame, np.ndarray)
            assert frame[0, 0, 0] == reds[k]
        assert video.read(6) == Rejected("ends before frame 6")
        assert isinstance(video.read(5), np.ndarray)


def test_videos_with_hostile_names_and_bad_ones(tmp_path):
    write_video(tmp_path / "a.avi")
    raw = (tmp_path / "a.avi").read_bytes()
    hostile = tmp_path / os.fsdecode(b"%03d\xff\n.avi")
    hostile.write_bytes(raw)
    with VideoReader(hostile) as video:
        assert len(list(video)) == 6
    (tmp_path / "bad.mp4").write_bytes(b"junk" * 50)
    assert VideoReader(tmp_path / "bad.mp4").reason == "is not a video that can be decoded"
    assert "cannot be read" in str(VideoReader(tmp_path / "none.mp4").reason)
    assert VideoReader(tmp_path).reason == "is not a regular file"

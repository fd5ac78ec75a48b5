"""JPEG pictures."""

import cv2

from gvpipe.core.types import Image


def jpeg_bytes(pixels: Image, quality: int = 95) -> bytes:
    """Encode an (H, W, 3) RGB or (H, W) grey picture.

    Parameters
    ----------
    pixels : (H, W, 3) or (H, W) uint8
        The picture.
    quality : int
        1 to 100, as libjpeg counts.

    Returns
    -------
    jpeg : bytes

    Raises
    ------
    ValueError
        If OpenCV cannot encode it.
    """
    bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    good, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not good:
        raise ValueError("the picture cannot be encoded as JPEG")
    return bytes(data.tobytes())

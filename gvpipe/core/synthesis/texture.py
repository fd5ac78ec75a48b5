"""Textures for made-up scenes: periodic, in many colours, with detail of every size."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float, Image

SIZE = 1024
"""Texels along each side; a power of two, so that every level of the pyramid is periodic."""


def _noise(rng: np.random.Generator, slope: float, coarsest: float, stretch: float = 1.0) -> Float:
    """Field of mean 0 and deviation 1 whose amplitude falls with frequency, (SIZE, SIZE).

    `stretch` draws its figures out along x.
    """
    down, across = np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None, :]
    frequency = np.hypot(down, stretch * across) * SIZE
    white = np.fft.rfft2(rng.normal(size=(SIZE, SIZE)))
    spectrum = white / np.maximum(frequency, coarsest) ** slope
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.asarray(field / field.std())


def stone(rng: np.random.Generator) -> Image:
    """Grey grain with coloured patches: easy ground."""
    shade = 22 * _noise(rng, 1.2, 12.0)
    colour = 128 + shade[..., None] + 4 * np.stack([_noise(rng, 1.2, 8.0) for _ in range(3)], -1)
    for tint in ((30.0, 12.0, -12.0), (-22.0, 8.0, 20.0), (14.0, -20.0, 4.0)):
        patches = 1.0 / (1.0 + np.exp(-8.0 * (_noise(rng, 2.0, 25.0) - 0.8)))
        colour += patches[..., None] * np.array(tint)
    return np.clip(colour, 0, 255).astype(np.uint8)


def carpet(rng: np.random.Generator) -> Image:
    """Woven threads in large coloured figures."""
    figures = np.stack([_noise(rng, 2.2, 6.0) for _ in range(3)], axis=-1)
    colour = np.array([120.0, 80.0, 70.0]) + 30 * np.tanh(2 * figures)
    v, u = np.mgrid[0:SIZE, 0:SIZE] * (2 * np.pi * 128 / SIZE)
    weave = 8 * np.sin(u) * np.sin(v) + 14 * _noise(rng, 0.6, 60.0)
    return np.clip(colour + weave[..., None], 0, 255).astype(np.uint8)


def tiles(rng: np.random.Generator) -> Image:
    """Sixteen square tiles with joints, each with a shade of its own: repetitive ground."""
    count, joint = 4, 6
    side = SIZE // count
    shades = np.repeat(np.repeat(rng.normal(size=(count, count, 3)), side, 0), side, 1)
    colour = np.array([165.0, 150.0, 130.0]) + 9 * shades + 9 * _noise(rng, 1.3, 10.0)[..., None]
    at = np.arange(SIZE) % side < joint
    colour[at[:, None] | at[None, :]] = (95.0, 90.0, 85.0)
    colour += 5 * _noise(rng, 0.4, 80.0)[..., None]
    return np.clip(colour, 0, 255).astype(np.uint8)


def wood(rng: np.random.Generator) -> Image:
    """Boards with grain along x."""
    boards = np.repeat(rng.normal(size=8), SIZE // 8)[:, None]
    shade = 20 * _noise(rng, 1.0, 20.0, stretch=25.0) + 12 * boards + 6 * _noise(rng, 1.0, 20.0)
    colour = np.array([150.0, 105.0, 65.0]) + shade[..., None] * np.array([1.0, 0.85, 0.65])
    return np.clip(colour, 0, 255).astype(np.uint8)


TEXTURES: dict[str, Callable[[np.random.Generator], Image]] = {
    "stone": stone,
    "carpet": carpet,
    "tiles": tiles,
    "wood": wood,
}
"""By name: a random generator to a periodic (SIZE, SIZE, 3) picture."""


def of_picture(pixels: Image) -> Image:
    """Any picture as a texture: stretched to a square and repeated."""
    square = cv2.resize(pixels, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return np.asarray(square, dtype=np.uint8)


@dataclass(frozen=True)
class Pyramid:
    """Textures at every resolution, ready to be sampled without aliasing.

    Attributes
    ----------
    texels : (T, M, 3) float32
        All levels of each of T textures one after the other, row by row, 0 to 255.
    starts, sizes : (L,) int64
        Where each level begins among the M texels, and its side.
    periods : (T,) float64
        Length on the surface after which each texture repeats, metres.
    """

    texels: NDArray[np.float32]
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    periods: Float


def pyramid(textures: list[Image], periods: list[float]) -> Pyramid:
    """Average textures down to one texel.

    Parameters
    ----------
    textures : list of (SIZE, SIZE, 3) uint8
        Periodic pictures.
    periods : list of float
        Metres after which each repeats.

    Returns
    -------
    pyramid : Pyramid
    """
    sizes = SIZE >> np.arange(int(np.log2(SIZE)) + 1)
    starts = np.concatenate([[0], np.cumsum(sizes**2)[:-1]])
    texels = np.empty((len(textures), int((sizes**2).sum()), 3), np.float32)
    for k, texture in enumerate(textures):
        level = texture.astype(np.float32)
        for start, size in zip(starts, sizes, strict=True):
            texels[k, start : start + size**2] = level.reshape(-1, 3)
            if size > 1:
                level = level.reshape(size // 2, 2, size // 2, 2, 3).mean(axis=(1, 3))
    return Pyramid(texels, starts.astype(np.int64), sizes.astype(np.int64), np.array(periods))

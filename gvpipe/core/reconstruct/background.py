"""What the bare ground would look like in a view: the background the obstacles stand out from."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.kernels.background import ground_behind
from gvpipe.core.reconstruct.views import below_horizon, upward_rays
from gvpipe.core.types import Float, PosedView

REACH = 6.0
"""Ground farther from a camera than this many of its heights shows no detail: not compared."""

WELL_SEEN = 1.5
"""Weight of views from which on what they show of a ground point can be relied on."""

MOST_OTHERS = 24
"""Views asked for the background of one: the nearest; the cost grows with their square."""

Mask = NDArray[np.uint8]
"""(H, W) uint8: 255 where it holds, 0 where not."""


@dataclass(frozen=True)
class GroundModel:
    """The ground as one picture seen from above, obstacles removed.

    Attributes
    ----------
    raster : (h, w, 4) uint8
        RGBA; alpha 0 where the ground was never seen.
    map_from_pixel : (3, 3) float64
        Takes homogeneous raster pixels (u, v, 1) to map coordinates on the ground, metres.
    """

    raster: NDArray[np.uint8]
    map_from_pixel: Float


@dataclass(frozen=True)
class Background:
    """The ground expected behind every pixel of one view.

    Attributes
    ----------
    colour : (H, W, 3) float32
        RGB 0..255; meaningless where not known.
    known : (H, W) bool
        True where the pixel's ray meets ground that the model holds.
    """

    colour: NDArray[np.float32]
    known: NDArray[np.bool_]


def rendered_background(view: PosedView, ground: GroundModel) -> Background:
    """Render the ground model into a view (the B(H x) of thesis eq. 5.6.1)."""
    height, width = view.pixels.shape[:2]
    pixel_from_raster = pixel_from_plane(view.camera, view.map_from_camera) @ ground.map_from_pixel
    # warping takes the raster as it is, so that the part of it behind the camera must be cut by
    # the sign of the depth, which the warp itself does not see
    raster_from_pixel = np.linalg.inv(pixel_from_raster)
    rendered = cv2.warpPerspective(
        ground.raster,
        raster_from_pixel,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(0, 0, 0, 0),
    )
    known = (rendered[..., 3] == 255) & below_horizon(view)
    return Background(rendered[..., :3].astype(np.float32), known)


@dataclass(frozen=True)
class GroundBehind:
    """The ground behind every pixel of one view as the other views show it.

    Attributes
    ----------
    colour : (H, W, 3) float32
        The colour most views agree on.
    support : (H, W) float32
        Weight of the views that agree; 0 where none sees the ground.
    open_weight, total_weight : (H, W) float32
        Weight of the views from which no known obstacle hides the ground, and of all views.
    solid : (H, W) bool
        Where the view may show an obstacle: everywhere until obstacles become known.
    """

    colour: NDArray[np.float32]
    support: NDArray[np.float32]
    open_weight: NDArray[np.float32]
    total_weight: NDArray[np.float32]
    solid: NDArray[np.bool_]


@dataclass
class GroundWitnesses:
    """Posed pictures that can tell each other what the ground looks like.

    Attributes
    ----------
    views : list of PosedView
        With the pictures to compare (levelled, perhaps reduced).
    hidden : (N, H, W) uint8
        255 where an obstacle hides the ground in a picture; replaced as obstacles become known.
    solid : (N, H, W) uint8
        Not 0 where a picture may show an obstacle: everywhere until obstacles become known.
    """

    views: list[PosedView]
    hidden: NDArray[np.uint8] = field(init=False)
    solid: NDArray[np.uint8] = field(init=False)

    def __post_init__(self) -> None:
        sizes = [(v.camera.width, v.camera.height) for v in self.views]
        self._sizes = np.array(sizes, dtype=np.int64)
        width, height = self._sizes.max(axis=0)
        self._images = np.zeros((len(sizes), height, width, 3), np.uint8)
        for k, (w, h) in enumerate(sizes):
            self._images[k, :h, :w] = self.views[k].pixels
        self.hidden = np.zeros((len(sizes), height, width), np.uint8)
        self.solid = np.full_like(self.hidden, 255)
        self._pixel_from_ground = np.stack(
            [pixel_from_plane(v.camera, v.map_from_camera) for v in self.views]
        )
        self._centres = np.stack([v.map_from_camera.translation for v in self.views])

    def hide(self, hidden: Sequence[Mask], solid: Sequence[Mask]) -> None:
        """Say where obstacles hide the ground and where they stand: masks a view, of any size."""
        for k, (w, h) in enumerate(self._sizes.tolist()):
            for into, mask in ((self.hidden, hidden[k]), (self.solid, solid[k])):
                into[k, :h, :w] = cv2.resize(mask, (w, h), interpolation=cv2.INTER_LINEAR)

    def behind(self, index: int, colour_scale: float) -> GroundBehind:
        """Ask the other views for the ground behind one; colours closer than the scale agree."""
        view = self.views[index]
        shape = view.pixels.shape[:2]
        colour = np.zeros((*shape, 3), np.float32)
        support, opened, total = (np.zeros(shape, np.float32) for _ in range(3))
        solid = self.solid[index, : shape[0], : shape[1]] > 0
        ground_behind(
            index,
            self._others(index),
            self._images,
            self.hidden,
            self._sizes,
            self._pixel_from_ground,
            np.ascontiguousarray(np.linalg.inv(self._pixel_from_ground[index])),
            upward_rays(view.camera, view.map_from_camera),
            self._centres,
            colour_scale,
            REACH,
            solid,
            colour,
            support,
            opened,
            total,
        )
        return GroundBehind(colour, support, opened, total, solid)

    def _others(self, index: int) -> NDArray[np.int64]:
        """Return the views whose pictures centre on ground nearest to where this one does."""
        aims = np.array([_aim(v) for v in self.views])
        distance = np.hypot(*(aims - aims[index]).T)
        order = np.argsort(distance, kind="stable")
        return np.sort(order[order != index][:MOST_OTHERS])


def _aim(view: PosedView) -> Float:
    """Ground point, (2,) metres, that the optical axis meets, at most 3 camera heights ahead."""
    axis, centre = view.map_from_camera.rotation[:, 2], view.map_from_camera.translation
    level = float(np.hypot(axis[0], axis[1]))
    reach = 3.0 * centre[2]
    ahead = min(reach, centre[2] * level / -axis[2]) if axis[2] < 0 else reach
    point: Float = centre[:2] + ahead * axis[:2] / max(level, 1e-9)
    return point

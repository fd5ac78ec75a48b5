"""Intrinsics from photographs of a printed board: chessboard or ChArUco."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gvpipe.core.types import Float, Image, Rejected

FEWEST_VIEWS = 3
"""Fewer views of a plane leave some of the intrinsics open."""

FEWEST_CORNERS = 8
"""A view with fewer corners is left out."""

LEAST_TURN_DEG = 12.0
"""Boards that all lie within this of one direction leave the focal length open."""

DICTIONARY = cv2.aruco.DICT_4X4_250
"""Markers of ChArUco boards."""


@dataclass(frozen=True)
class Board:
    """A printed board.

    Attributes
    ----------
    columns, rows : int
        Squares of a ChArUco board; inner corners of a chessboard.
    square_m : float
        Side of a square, metres.
    marker_m : float
        Side of the markers, metres; 0 for a chessboard.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0


@dataclass(frozen=True)
class BoardView:
    """Corners found in one picture.

    Attributes
    ----------
    pixels : (N, 2) float32
        Where they were seen.
    places : (N, 3) float32
        Where they are on the board, metres.
    """

    pixels: NDArray[np.float32]
    places: NDArray[np.float32]


@dataclass(frozen=True)
class BoardCalibration:
    """Intrinsics with their uncertainty.

    Attributes
    ----------
    matrix : (3, 3) float64
        K.
    distortion : tuple of float
        k1 k2 p1 p2 k3.
    sigma : (4,) float64
        Standard deviations of fx, fy, cx, cy.
    error_px : float
        Root mean square reprojection error.
    views : tuple of int
        Which views were used.
    view_errors_px : tuple of float
        Root mean square error of each of them.
    """

    matrix: Float
    distortion: tuple[float, ...]
    sigma: Float
    error_px: float
    views: tuple[int, ...]
    view_errors_px: tuple[float, ...]


def find_board(pixels: Image, board: Board) -> BoardView | Rejected:
    """Find a board's corners in a picture.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        As photographed.
    board : Board
        What to look for.

    Returns
    -------
    view : BoardView or Rejected
        Rejected if it shows no board, or too few of its corners.
    """
    grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
    view = _find_charuco(grey, board) if board.marker_m else _find_chessboard(grey, board)
    if isinstance(view, BoardView) and len(view.pixels) < FEWEST_CORNERS:
        return Rejected(f"shows {len(view.pixels)} corners of the board, {FEWEST_CORNERS} needed")
    return view


def _find_chessboard(grey: NDArray[np.uint8], board: Board) -> BoardView | Rejected:
    """Find all inner corners, or none."""
    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    good, corners = cv2.findChessboardCornersSB(grey, size, flags=flags)
    if not good or corners is None:
        return Rejected(f"shows no chessboard of {board.columns} x {board.rows} inner corners")
    column, row = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    places = np.column_stack([column.ravel(), row.ravel(), np.zeros(column.size)]) * board.square_m
    return BoardView(
        np.asarray(corners, dtype=np.float32).reshape(-1, 2), places.astype(np.float32)
    )


def _find_charuco(grey: NDArray[np.uint8], board: Board) -> BoardView | Rejected:
    """Find the corners between the markers that are seen."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    size = (board.columns, board.rows)
    pattern = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    if ids is None or corners is None:
        return Rejected("shows no ChArUco board")
    places = np.asarray(pattern.getChessboardCorners(), np.float32)[ids.ravel()]
    return BoardView(np.asarray(corners, dtype=np.float32).reshape(-1, 2), places)


def calibrate_board(
    views: Sequence[BoardView], size: tuple[int, int]
) -> BoardCalibration | Rejected:
    """Estimate the intrinsics from several views of a board (Zhang 2000).

    Parameters
    ----------
    views : sequence of BoardView
        From :func:`find_board`.
    size : (int, int)
        Width and height of the pictures.

    Returns
    -------
    calibration : BoardCalibration or Rejected
        Rejected if there are too few views or all show the board from one direction.
    """
    if len(views) < FEWEST_VIEWS:
        return Rejected(f"{len(views)} pictures show the board, {FEWEST_VIEWS} needed")
    outcome = cv2.calibrateCameraExtended(
        [v.places[:, None] for v in views],
        [v.pixels[:, None] for v in views],
        size,
        np.eye(3),
        np.zeros(5),
    )
    error_px, matrix, distortion, turns, _, deviations, _, each = outcome
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    widest = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max()
    if widest < LEAST_TURN_DEG:
        return Rejected(
            f"the board is seen within {widest:.0f} degrees of one direction, "
            f"{LEAST_TURN_DEG:.0f} needed: tilt it between pictures"
        )
    return BoardCalibration(
        matrix=np.asarray(matrix, np.float64),
        distortion=tuple(float(v) for v in distortion.ravel()[:5]),
        sigma=np.asarray(deviations, np.float64).ravel()[:4],
        error_px=float(error_px),
        views=tuple(range(len(views))),
        view_errors_px=tuple(float(v) for v in np.ravel(each)),
    )

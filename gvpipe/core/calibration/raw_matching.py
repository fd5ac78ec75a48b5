"""Plane homographies between pictures of an unknown camera: nothing but their pixels is used."""

from dataclasses import dataclass

import cv2
import numpy as np

from gvpipe.core.matching.features import Features
from gvpipe.core.matching.sift import candidate_matches
from gvpipe.core.types import Float, Image, Rejected

KEYPOINTS = 2500
"""Most keypoints a picture."""

MAX_RATIO = 0.8
"""Largest distance to the nearest descriptor over that to the second nearest (Lowe 2004)."""

THRESHOLD_PX = 2.5
"""Transfer error of an inlier on a picture of a megapixel: lens distortion is in it still."""

FEWEST_INLIERS = 20
"""Chance reaches 13 on pictures that share nothing."""

MOST_PLANES = 3
"""Planes looked for in a pair: the faces of things may hold more matches than the ground."""

MAX_TRIALS = 5000
"""Random samples for one plane, at most."""


@dataclass(frozen=True)
class PlanePair:
    """Points of one plane seen in two pictures.

    Attributes
    ----------
    i, j : int
        Numbers of the pictures.
    homography : (3, 3) float64
        Pixels of i to pixels of j.
    points_i, points_j : (N, 2) float64
        Matched pixels.
    """

    i: int
    j: int
    homography: Float
    points_i: Float
    points_j: Float


def raw_features(pixels: Image) -> Features:
    """Find SIFT keypoints of a whole picture.

    Parameters
    ----------
    pixels : (H, W, 3) uint8
        As photographed.

    Returns
    -------
    features : Features
        Its ground points are its pixels.
    """
    detector = cv2.SIFT.create(KEYPOINTS)
    keypoints, histograms = detector.detectAndCompute(
        cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), None
    )
    points = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
    h = np.asarray(histograms if len(points) else np.empty((0, 128)), dtype=np.float64)
    h = np.sqrt(h / np.maximum(h.sum(axis=1, keepdims=True), 1e-9))
    return Features(
        kind="raw",
        pixels=points,
        ground=points,
        descriptors=np.rint(255.0 * h).astype(np.uint8),
        pixels_per_metre=1.0,
        angle=np.radians([k.angle for k in keypoints]).astype(np.float64),
        size=np.array([k.size for k in keypoints], dtype=np.float64),
        dark=np.zeros(len(points), bool),
    )


def match_planes(
    i: int, j: int, features_i: Features, features_j: Features, scale: float = 1.0
) -> list[PlanePair] | Rejected:
    """Find the planes that matches of two pictures lie on, the one with most matches first.

    Parameters
    ----------
    i, j : int
        Numbers of the pictures; with nothing else they fix the random choices.
    features_i, features_j : Features
        From :func:`raw_features`.
    scale : float
        Size of the pictures over a megapixel's, along a side.

    Returns
    -------
    pairs : list of PlanePair, or Rejected
        At most :data:`MOST_PLANES`; which of them is the ground is not known here.
    """
    index_i, index_j, _ = candidate_matches(features_i, features_j, MAX_RATIO)
    points_i, points_j = features_i.pixels[index_i], features_j.pixels[index_j]
    planes: list[PlanePair] = []
    cv2.setRNGSeed(1 + i * 65536 + j)
    while len(points_i) >= FEWEST_INLIERS and len(planes) < MOST_PLANES:
        found, mask = cv2.findHomography(
            points_i,
            points_j,
            cv2.USAC_MAGSAC,
            THRESHOLD_PX * scale,
            maxIters=MAX_TRIALS,
            confidence=0.9999,
        )
        inlier = np.zeros(len(points_i), bool) if mask is None else mask.ravel() > 0
        if found is None or inlier.sum() < FEWEST_INLIERS:
            break
        homography: Float = np.array(found, dtype=np.float64)
        planes.append(PlanePair(i, j, homography, points_i[inlier], points_j[inlier]))
        points_i, points_j = points_i[~inlier], points_j[~inlier]
    if not planes:
        return Rejected(f"{len(index_i)} matches, no {FEWEST_INLIERS} of them on one plane")
    return planes

"""Cost and accuracy of matching against SIFT + ratio test + MAGSAC on the raw pictures.

Run ``python -m tests.bench.bench_match`` from the repository. CPU seconds of one thread, pictures
decoded beforehand.
"""

import argparse
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from gvpipe.core.geometry.homography import transfer_errors
from gvpipe.core.matching.features import MatchOptions
from gvpipe.core.matching.matchers import MATCHERS, extract, match_views
from gvpipe.core.types import Camera, Float, PairMatch, View
from tests.synthetic import Scene, common_ground, texture, true_homography, view_at

CAMERA = Camera(width=640, height=480, fx=545.0, fy=545.0, cx=319.5, cy=239.5)
OPTIONS = MatchOptions()


def raw_sift(a: View, b: View) -> Float | None:
    """What people use today: nothing is known of the cameras."""
    sift = cv2.SIFT.create(4000)
    (k_a, d_a), (k_b, d_b) = (
        sift.detectAndCompute(cv2.cvtColor(v.pixels, cv2.COLOR_RGB2GRAY), None) for v in (a, b)
    )
    pairs = cv2.BFMatcher().knnMatch(d_a, d_b, k=2)
    good = [m for m, n in pairs if m.distance < 0.8 * n.distance]
    if len(good) < 8:
        return None
    p = np.array([k_a[m.queryIdx].pt for m in good])
    q = np.array([k_b[m.trainIdx].pt for m in good])
    return cv2.findHomography(p, q, cv2.USAC_MAGSAC, 2.0, None, 10000, 0.9999)[0]


def scenes() -> Iterator[tuple[View, View, Float, Float]]:
    """Pairs of views, their true homography and the pixels of the first it is judged at."""
    scene = Scene(texture(np.random.default_rng(3), 2048))
    for yaw, x, y, tilt in ((20, 0.2, 0.1, 35), (90, 0.8, -0.8, 40), (180, 1.7, 0.2, 35)):
        a, pose_a = view_at(scene, 0, 0, 0, 35, hint_deg=37, camera=CAMERA)
        b, pose_b = view_at(scene, x, y, yaw, tilt, hint_deg=tilt - 2, camera=CAMERA)
        true = true_homography(pose_a, pose_b, CAMERA, CAMERA)
        yield a, b, true, common_ground(true, pose_a, CAMERA, CAMERA)


def cpu(function: Callable[[], object]) -> tuple[float, object]:
    """Run once; CPU seconds and the result."""
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


def main() -> None:
    """Print one line a pair and method, then the ratios."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    cv2.setNumThreads(1)
    total = dict.fromkeys(("raw", *MATCHERS, *(f"{m} cached" for m in MATCHERS)), 0.0)
    for turn, (a, b, true, points) in enumerate([next(scenes()), *scenes()]):
        one = np.column_stack([points, np.ones(len(points))]) @ true.T
        found: dict[str, object] = {}
        spent: dict[str, float] = {}
        spent["raw"], found["raw"] = cpu(lambda a=a, b=b: raw_sift(a, b))
        for method in MATCHERS:
            options = MatchOptions(features=method)
            first, features = cpu(lambda a=a, b=b, o=options: (extract(a, o), extract(b, o)))
            cached, match = cpu(
                lambda a=a, b=b, f=features, o=options: match_views(
                    a, b, *f, o, np.random.default_rng(0)
                )
            )
            spent[method], spent[f"{method} cached"] = first + cached, cached
            found[method] = match.homography if isinstance(match, PairMatch) else None
        if turn == 0:
            continue  # kernels are compiled or loaded
        for name in total:
            total[name] += spent[name]
        for name, h in found.items():
            error = (
                "rejected"
                if h is None
                else f"{transfer_errors(h, points, one[:, :2] / one[:, 2:]).mean():.3f} px"
            )
            print(f"pair {turn} {name:10s} {spent[name]:.3f} s  {error}")  # noqa: T201
    for name in total:
        print(f"{name:18s} {total[name] / total['raw']:.2f} of raw")  # noqa: T201


if __name__ == "__main__":
    main()

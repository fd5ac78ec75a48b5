"""Command line of ``gvpipe synth``."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gvpipe.errors import UsageError
from gvpipe.tools.options import LogJson, Quiet, Verbose, option

if TYPE_CHECKING:  # loaded late: the command line stays quick
    from gvpipe.core.synthesis.solids import Solid
    from gvpipe.core.types import Camera


Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="New folder for pictures, truth and CONFIG.")
]
PathName = Annotated[
    str, option("--path", "circle, line, mower (to and fro), or a TUM file of camera poses.")
]
Radius = Annotated[
    float | None,
    option(
        "--radius",
        "Of the circle, metres.",
        min=0.01,
        show_default="the camera looks at its middle",
    ),
]
Boxes = Annotated[
    list[str] | None, option("--box", "X,Y,WIDTH,DEPTH,HEIGHT[,YAW]; may be repeated.")
]
Cylinders = Annotated[list[str] | None, option("--cylinder", "X,Y,RADIUS,HEIGHT; may be repeated.")]
Spheres = Annotated[list[str] | None, option("--sphere", "X,Y,RADIUS; may be repeated.")]


def add(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "synth",
        help="Render photographs of a made-up scene with known truth. Says how much ground "
        "consecutive pictures share and how large a pixel is on the ground, so that height, tilt "
        "and spacing can be tried before driving.",
        epilog="Example: gvpipe synth trial --path line --images 12 --spacing 0.3 --tilt 35",
    )(synth)


def _size(text: str) -> tuple[int, int]:
    """Read ``640x480``."""
    width, cross, height = text.partition("x")
    if not cross or not width.isdecimal() or not height.isdecimal():
        raise UsageError(f"--size {text!r}: expected WIDTHxHEIGHT in pixels, for example 640x480")
    size = int(width), int(height)
    if not all(16 <= side <= 8192 for side in size):
        raise UsageError(f"--size {text}: expected 16 to 8192 pixels along each side")
    return size


def _camera(size: str, fov_deg: float) -> "Camera":
    """Centre a lens of a horizontal field of view on pictures of a size."""
    from gvpipe.core.types import Camera

    width, height = _size(size)
    focal = 0.5 * width / math.tan(math.radians(fov_deg) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _numbers(name: str, text: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Read numbers between commas."""
    try:
        values = tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError:
        values = (math.nan,)
    if len(values) not in counts or not all(map(math.isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise UsageError(f"{name} {text!r}: expected {wanted} numbers with commas between")
    return values


def _solids(given: dict[str, list[str]], *, empty: bool) -> "tuple[Solid, ...]":
    """Read what stands on the ground: one of each kind if nothing is said."""
    from gvpipe.commands.scene_plan import default_solids, parse_solid
    from gvpipe.core.synthesis.solids import KINDS

    said = [(kind, text) for kind in KINDS for text in given[kind]]
    if empty and said:
        raise UsageError("--empty excludes --box, --cylinder and --sphere")
    if empty:
        return ()
    solids = tuple(parse_solid(kind, text, k) for k, (kind, text) in enumerate(said))
    return solids or default_solids()


def synth(
    folder: Folder,
    path: PathName = "circle",
    images: Annotated[int, option("--images", "Pictures in all.", min=1, max=9999)] = 12,
    robots: Annotated[int, option("--robots", "Robots that share the path.", min=1, max=26)] = 1,
    radius: Radius = None,
    spacing: Annotated[
        float, option("--spacing", "Between stops, and rows of the mower, metres.", min=0.001)
    ] = 0.25,
    rows: Annotated[int, option("--rows", "Rows of the mower.", min=1)] = 3,
    height: Annotated[
        float, option("--height", "Camera above the ground, metres.", min=0.01, max=1000)
    ] = 0.6,
    tilt: Annotated[
        float, option("--tilt", "Optical axis below the horizon, degrees.", min=0.1, max=90)
    ] = 40.0,
    roll: Annotated[
        float, option("--roll", "About the optical axis, degrees.", min=-44, max=44)
    ] = 0.0,
    shake: Annotated[
        float, option("--shake", "How much tilt, roll and heading vary, degrees.", min=0, max=10)
    ] = 0.0,
    size: Annotated[str, option("--size", "Of the pictures, pixels.")] = "640x480",
    fov: Annotated[
        float, option("--fov", "Horizontal field of view, degrees.", min=5, max=140)
    ] = 63.0,
    distortion: Annotated[
        str, option("--distortion", "Lens, OpenCV order: k1,k2,p1,p2[,k3].")
    ] = "",
    box: Boxes = None,
    cylinder: Cylinders = None,
    sphere: Spheres = None,
    empty: Annotated[
        bool, option("--empty", "Nothing stands on the ground; else one of each.")
    ] = False,
    ground: Annotated[
        str, option("--ground", "stone, carpet, tiles, wood, or a picture of your floor.")
    ] = "stone",
    noise: Annotated[float, option("--noise", "Sensor noise, grey levels.", min=0, max=100)] = 1.5,
    png: Annotated[bool, option("--png", "Write PNG, not JPEG.")] = False,
    seed: Annotated[int, option("--seed", "Same seed, same pictures.", min=0)] = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Render photographs of a made-up scene, to plan a capture or to test."""
    from gvpipe.commands.scene_plan import Plan
    from gvpipe.commands.synth import run
    from gvpipe.core.types import Mount
    from gvpipe.report import Reporter

    given = {"box": box or [], "cylinder": cylinder or [], "sphere": sphere or []}
    plan = Plan(
        solids=_solids(given, empty=empty),
        ground=ground,
        path=path,
        images=images,
        robots=robots,
        rows=rows,
        radius=radius or height / math.tan(math.radians(min(tilt, 80.0))),
        spacing=spacing,
        camera=_camera(size, fov),
        distortion=_numbers("--distortion", distortion, (0, 4, 5, 8)),
        mount=Mount(math.radians(tilt), math.radians(roll), height),
        shake=math.radians(shake),
        noise=noise,
        seed=seed,
        png=png,
    )
    run(plan, folder, Reporter(quiet=quiet, verbose=verbose, log_json=log_json))

"""Command lines of ``gvpipe evaluate``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from gvpipe.errors import UsageError
from gvpipe.tools.options import JsonPath, Quiet, argument, option

Align = Annotated[
    Literal["none", "origin", "yaw", "se3", "sim3"],
    option(
        "--align",
        "What is fitted first: none; origin = the first poses; yaw = heading and position over "
        "level ground; se3 = rigid; sim3 = rigid and scale.",
    ),
]


def add(app: typer.Typer) -> None:
    """Add the commands."""
    evaluate = typer.Typer(
        help="Measure results against the truth: trajectories, homographies, meshes.",
        no_args_is_help=True,
    )
    app.add_typer(evaluate, name="evaluate")
    evaluate.command(
        "trajectory",
        help="Absolute and relative pose errors (ATE, RPE), as evo and the TUM benchmark define "
        "them. Files: TUM, KITTI, slam.json, groundtruth.json or the folder of a COLMAP text "
        "model; poses are paired by image name (or file name within each robot, robots in their "
        "order), else by time, else, where names or times are missing, by order.",
        epilog="Example: gvpipe evaluate trajectory run/slam/slam.json groundtruth.json",
    )(evaluate_trajectory)
    evaluate.command(
        "homography",
        help="How far matched homographies move ground pixels from where they belong; images are "
        "paired by name, or by file name within each robot, robots in their order.",
        epilog="Example: gvpipe evaluate homography run/match groundtruth.json",
    )(evaluate_homography)
    evaluate.command(
        "mesh",
        help="F-score, chamfer distance and common volume of two closed meshes.",
        epilog="Example: gvpipe evaluate mesh run/reconstruct/obstacles.ply obstacles.ply "
        "--poses run/slam/slam.json --true-poses groundtruth.json",
    )(evaluate_mesh)


def evaluate_trajectory(
    estimate: Annotated[Path, argument("Estimated poses.", "ESTIMATE")],
    reference: Annotated[Path, argument("True poses.", "TRUTH")],
    align: Align = "yaw",
    delta: Annotated[
        int, option("--delta", "Poses from start to end of a relative motion.", min=1)
    ] = 1,
    all_pairs: Annotated[
        bool, option("--all-pairs", "Relative motions start at every pose and overlap.")
    ] = False,
    max_gap: Annotated[
        float, option("--max-gap", "Largest difference of paired times, seconds.", min=0)
    ] = 0.01,
    json_path: JsonPath = None,
    quiet: Quiet = False,
) -> None:
    """Compare trajectories."""
    from gvpipe.commands.evaluate import trajectory
    from gvpipe.report import Reporter

    trajectory(
        estimate,
        reference,
        how=align,
        delta=delta,
        all_pairs=all_pairs,
        max_gap_s=max_gap,
        json_path=json_path,
        reporter=Reporter(quiet=quiet),
    )


def evaluate_homography(
    match: Annotated[Path, argument("match.json, or its folder.", "MATCH")],
    truth: Annotated[
        Path,
        argument("groundtruth.json, or a COLMAP text model with the ground at z = 0.", "TRUTH"),
    ],
    json_path: JsonPath = None,
    quiet: Quiet = False,
) -> None:
    """Compare homographies."""
    from gvpipe.commands.evaluate import homography
    from gvpipe.report import Reporter

    homography(match, truth, json_path=json_path, reporter=Reporter(quiet=quiet))


def evaluate_mesh(
    estimate: Annotated[Path, argument("Reconstructed mesh (PLY, GLB, OBJ, STL).", "ESTIMATE")],
    truth: Annotated[Path, argument("True mesh.", "TRUTH")],
    tolerance: Annotated[
        float, option("--tolerance", "What counts as near, metres.", min=1e-6)
    ] = 0.01,
    above: Annotated[
        float, option("--above", "Leave out surface below this height, metres.", min=0)
    ] = 0.01,
    spacing: Annotated[
        float, option("--spacing", "Cells that volumes are counted in, metres.", min=1e-5)
    ] = 0.005,
    poses: Annotated[
        Path | None, option("--poses", "Estimated poses; they place the mesh.", metavar="FILE")
    ] = None,
    true_poses: Annotated[
        Path | None, option("--true-poses", "True poses, for --poses.", metavar="FILE")
    ] = None,
    align: Align = "yaw",
    seed: Annotated[int, option("--seed", "Of the points drawn on the surfaces.", min=0)] = 0,
    json_path: JsonPath = None,
    quiet: Quiet = False,
) -> None:
    """Compare meshes."""
    if (poses is None) != (true_poses is None):
        raise UsageError("--poses and --true-poses belong together")
    from gvpipe.commands.evaluate_mesh import mesh
    from gvpipe.report import Reporter

    mesh(
        estimate,
        truth,
        tolerance_m=tolerance,
        above_m=above,
        spacing_m=spacing,
        poses=(poses, true_poses) if poses is not None and true_poses is not None else None,
        how=align,
        seed=seed,
        json_path=json_path,
        reporter=Reporter(quiet=quiet),
    )

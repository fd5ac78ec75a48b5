from dataclasses import replace

import numpy as np
import pytest

from gvpipe.core.geometry.ground import pixel_from_plane
from gvpipe.core.geometry.homography import apply
from gvpipe.core.geometry.pose import yaw_tilt_roll
from gvpipe.core.slam.links import Link, link_kind
from gvpipe.core.slam.location_graph import ControlPoint, MapOptions, build_map
from gvpipe.core.slam.loops import gap_candidates, loop_candidates, without_bridges
from gvpipe.core.types import Float, Mount, Pose
from tests.slam_scene import (
    Scene,
    arc_path,
    errors,
    loop_path,
    make_scene,
    mapped,
    replace_links,
    true_map,
)


def rms_m(found: Float) -> float:
    return float(np.sqrt((found[:, 3:] ** 2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def patrol() -> Scene:
    return make_scene({"A": loop_path(20)}, np.random.default_rng(1), wrong_matches=0.02)


@pytest.fixture(scope="module")
def team() -> Scene:
    there = arc_path(8)
    back = there[::-1] + np.array([0.3, 0.6, np.pi])
    return make_scene({"A": there, "B": back}, np.random.default_rng(2))


def test_the_map_frame_is_that_of_the_reference(patrol: Scene) -> None:
    result = build_map(
        patrol.cameras, patrol.mounts, patrol.order, patrol.links, "A/0003.jpg", MapOptions()
    )
    pose = result.poses["A/0003.jpg"].map_from_camera
    assert pose.translation[:2] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert yaw_tilt_roll(pose.rotation)[0] == pytest.approx(0.0, abs=1e-12)
    assert rms_m(errors(result, true_map(patrol, "A/0003.jpg"))) < 0.005
    covariance = result.poses["A/0003.jpg"].covariance
    assert np.allclose(covariance[[3, 4]], 0.0, atol=1e-15)


def test_a_closed_loop_closes(patrol: Scene) -> None:
    result = mapped(patrol)
    assert len(result.components) == 1
    assert all(link.kept for link in result.links)
    longest = result.closures[0]
    assert longest.chain_links >= 15
    assert longest.adjusted_m < 0.5 * longest.concatenated_m


def test_robots_meet_in_one_map(team: Scene) -> None:
    kinds = {link.kind for link in team.links}
    assert "overlap" in kinds
    result = mapped(team)
    assert len(result.poses) == 16
    assert rms_m(errors(result, true_map(team, "A/0000.jpg"))) < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_wrong_links_are_found_out(patrol: Scene, seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrong = rng.choice(len(patrol.links), max(1, len(patrol.links) // 20), replace=False)
    spoiled = replace(patrol, links=replace_links(patrol.links, wrong.tolist(), rng))
    result = mapped(spoiled)
    truth = true_map(patrol, "A/0000.jpg")
    assert not any(result.links[k].kept for k in wrong)
    assert all(result.links[k].reason for k in wrong)
    before = rms_m(errors(mapped(patrol), truth))
    assert rms_m(errors(result, truth)) == pytest.approx(before, rel=0.2)


def test_maps_of_many_matches_are_as_good(patrol: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    # each link alone: with corners that many links share, summing up forgets that they are shared
    truth = true_map(patrol, "A/0000.jpg")
    alone = replace(patrol, links=[x for x in patrol.links if x.kind == "loop" or near(x)])
    whole = rms_m(errors(mapped(alone), truth))
    monkeypatch.setattr("gvpipe.core.slam.map_part.MANY_MATCHES", 0)
    summed = rms_m(errors(mapped(alone), truth))
    assert summed < 1.5 * whole + 1e-3


def near(link: Link) -> bool:
    """Whether a link's pictures follow each other."""
    return int(link.image_j[2:6]) - int(link.image_i[2:6]) == 1


def test_matches_of_anything_but_the_ground_are_refused(patrol: Scene) -> None:
    rng = np.random.default_rng(5)
    link = patrol.links[0]
    noise = replace(link, points_j=rng.uniform(0, 400, link.points_j.shape))
    result = mapped(replace(patrol, links=[noise, *patrol.links[1:]]))
    assert not result.links[0].kept
    assert "not a motion over the ground" in result.links[0].reason


def test_what_is_not_connected_stays_apart(team: Scene) -> None:
    apart = replace(team, links=[link for link in team.links if link.kind != "overlap"])
    result = mapped(apart)
    assert [len(images) for images in result.components] == [8, 8]
    assert {result.poses[image].component for image in result.components[1]} == {1}
    home = result.poses["B/0000.jpg"].map_from_camera
    assert home.translation[:2] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_an_image_without_links_is_not_registered(patrol: Scene) -> None:
    lonely = "A/0007.jpg"
    links = [x for x in patrol.links if lonely not in (x.image_i, x.image_j)]
    result = mapped(replace(patrol, links=links))
    assert result.unregistered == ((lonely, "no link to another image"),)
    assert lonely not in result.poses
    assert len(result.poses) == 19


def test_images_can_be_missing(patrol: Scene) -> None:
    gone = {"A/0002.jpg", "A/0009.jpg", "A/0015.jpg"}
    scene = Scene(
        cameras=patrol.cameras,
        mounts=patrol.mounts,
        poses={image: pose for image, pose in patrol.poses.items() if image not in gone},
        links=[x for x in patrol.links if not {x.image_i, x.image_j} & gone],
    )
    result = mapped(scene)
    assert len(result.poses) == 17
    assert rms_m(errors(result, true_map(scene, "A/0000.jpg"))) < 0.005


@pytest.mark.parametrize("seed", range(3))
def test_a_sixth_of_the_images_hardly_matters(seed: int) -> None:
    # scale apart: the heights of fewer pictures say less about their mean
    full = make_scene({"A": loop_path(24)}, np.random.default_rng(seed), bounce=0.0, max_gap=3)
    rng = np.random.default_rng(seed)
    gone = set(rng.choice(full.order[1:], 4, replace=False).tolist())
    left = Scene(
        cameras=full.cameras,
        mounts=full.mounts,
        poses={image: pose for image, pose in full.poses.items() if image not in gone},
        links=[x for x in full.links if not {x.image_i, x.image_j} & gone],
    )
    truth = true_map(full, "A/0000.jpg")
    result, whole = mapped(left), mapped(full)
    assert len(result.components) == 1
    same = replace(whole, poses={x: p for x, p in whole.poses.items() if x not in gone})
    assert rms_m(errors(result, truth)) < 1.2 * rms_m(errors(same, truth)) + 5e-4


def test_an_unknown_tilt_is_found(patrol: Scene) -> None:
    guess = Mount(tilt=np.radians(60.0), roll=0.0, height=0.6, tilt_known=False)
    scene = replace(patrol, mounts=dict.fromkeys(patrol.order, guess))
    result = mapped(scene)
    assert rms_m(errors(result, true_map(scene, "A/0000.jpg"))) < 0.005


def test_one_image_is_a_map() -> None:
    scene = make_scene({"A": arc_path(1)}, np.random.default_rng(3), density=1.0)
    result = mapped(scene)
    assert list(result.poses) == ["A/0000.jpg"]
    assert result.poses["A/0000.jpg"].map_from_camera.translation[2] == pytest.approx(0.6)


def test_strangers_are_an_error(patrol: Scene) -> None:
    with pytest.raises(ValueError, match="not among the images"):
        build_map(
            patrol.cameras, patrol.mounts, patrol.order, patrol.links, "A/9.jpg", MapOptions()
        )


def test_the_result_does_not_depend_on_the_run(patrol: Scene) -> None:
    one, two = mapped(patrol), mapped(patrol)
    for image, posed in one.poses.items():
        other = two.poses[image]
        assert (posed.map_from_camera.rotation == other.map_from_camera.rotation).all()
        assert (posed.covariance == other.covariance).all()


def test_kinds_of_links() -> None:
    place = {image: k for k, image in enumerate([f"A/{k}.jpg" for k in range(9)] + ["B/0.jpg"])}
    assert link_kind(place, "A/0.jpg", "A/1.jpg") == "odometry"
    assert link_kind(place, "A/8.jpg", "A/0.jpg") == "loop"
    assert link_kind(place, "A/0.jpg", "B/0.jpg") == "overlap"


def test_loops_are_proposed_where_footprints_overlap(patrol: Scene) -> None:
    poses = true_map(patrol, "A/0000.jpg")
    odometry: list[Link] = [x for x in patrol.links if x.kind == "odometry"]
    linked = [(x.image_j, x.image_i) for x in odometry]
    found = loop_candidates(patrol.cameras, poses, linked, min_share=0.1, max_per_image=3)
    shares = [c.share for c in found]
    assert shares == sorted(shares, reverse=True)
    pairs = {frozenset((c.image_i, c.image_j)) for c in found}
    assert frozenset(("A/0000.jpg", "A/0019.jpg")) in pairs
    assert not pairs & {frozenset(pair) for pair in linked}
    counts = [sum(image in pair for pair in pairs) for image in poses]
    assert max(counts) <= 3


def test_gaps_in_a_chain_are_bridged() -> None:
    order = ["A/0.jpg", "A/1.jpg", "A/2.jpg", "A/3.jpg", "B/0.jpg"]
    found = gap_candidates(order, [("A/0.jpg", "A/1.jpg")], [("A/1.jpg", "A/2.jpg")], max_gap=2)
    pairs = [(c.image_i, c.image_j) for c in found]
    assert pairs == [("A/2.jpg", "A/3.jpg"), ("A/0.jpg", "A/2.jpg"), ("A/1.jpg", "A/3.jpg")]


def test_maps_that_keep_the_same_links_confirm_each_other(patrol: Scene) -> None:
    result = mapped(patrol)
    more = replace(result, links=(*result.links, replace(result.links[0], kept=False)))
    assert result.confirmed_by(more)
    first = replace(result.links[0], kept=not result.links[0].kept)
    assert not result.confirmed_by(replace(more, links=(first, *more.links[1:])))
    split = tuple((image,) for component in result.components for image in component)
    assert not result.confirmed_by(replace(more, components=split))


def test_images_held_by_one_link_only_are_set_apart() -> None:
    links = [("a", "b"), ("b", "c"), ("c", "a"), ("c", "d"), ("d", "e"), ("e", "f"), ("f", "d")]
    parts = without_bridges("abcdefg", links)
    assert {frozenset(part) for part in parts} == {frozenset(x) for x in ("abc", "def", "g")}
    # two links between the same images confirm each other
    assert len(without_bridges("ab", [("a", "b"), ("a", "b")])) == 1


def seen_points(
    scene: Scene, where: list[tuple[str, float, float]], shift: Float, turn: float
) -> list[ControlPoint]:
    """Clicks on points so far before and left of the cameras of images; in another frame."""
    c, s = np.cos(turn), np.sin(turn)
    points = []
    for image, ahead, left in where:
        pose = scene.poses[image]
        yaw = yaw_tilt_roll(pose.rotation)[0]
        way = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        world = pose.translation[:2] + way @ [ahead, left]
        u, v = apply(pixel_from_plane(scene.cameras[image], pose), world[None])[0]
        x, y = np.array([[c, -s], [s, c]]) @ world + shift
        points.append(ControlPoint(image, (float(u), float(v)), (float(x), float(y))))
    return points


def test_known_points_fix_frame_and_scale() -> None:
    # the configured heights are 3 % off; two known points far apart put that right
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene = make_scene({"A": loop_path(16)}, rng)
        mounts = {x: replace(m, height=1.03 * m.height) for x, m in scene.mounts.items()}
        shift, turn = np.array([100.0, -50.0]), 0.7
        known = seen_points(
            scene,
            [("A/0002.jpg", 0.7, 0.1), ("A/0007.jpg", 0.8, -0.1), ("A/0011.jpg", 0.9, 0.0)],
            shift,
            turn,
        )
        clicked = [
            replace(p, pixel=(p.pixel[0] + rng.normal(), p.pixel[1] + rng.normal())) for p in known
        ]
        result = build_map(
            scene.cameras, mounts, scene.order, scene.links, scene.order[0], MapOptions(), clicked
        )
        assert result.ground[0].fixed
        c, s = np.cos(turn), np.sin(turn)
        site = Pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.append(shift, 0.0))
        found = errors(result, {image: site @ pose for image, pose in scene.poses.items()})
        assert rms_m(found) < 0.008
        covariances = [posed.covariance for posed in result.poses.values()]
        squares += [e @ np.linalg.solve(c, e) / 6 for e, c in zip(found, covariances, strict=True)]
    assert 0.6 < np.mean(squares) < 1.5


def test_one_known_point_fixes_nothing(patrol: Scene) -> None:
    known = seen_points(patrol, [("A/0002.jpg", 0.7, 0.1)] * 2, np.zeros(2), 0.0)
    result = build_map(
        patrol.cameras, patrol.mounts, patrol.order, patrol.links, "A/0000.jpg", MapOptions(), known
    )
    assert not result.ground[0].fixed
    pose = result.poses["A/0000.jpg"].map_from_camera
    assert pose.translation[:2] == pytest.approx([0.0, 0.0], abs=1e-12)
